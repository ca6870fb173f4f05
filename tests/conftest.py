"""This file lets tests import `helpers`, and keeps random numbers the same in every run."""

from __future__ import annotations

import hypothesis
import pytest
import torch

# Fixtures that several files share.
pytest_plugins = ("helpers.run_fixtures",)

# The same examples in every run: a failure that comes and goes helps nobody.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None)
hypothesis.settings.load_profile("repeatable")
# Tests run in several processes; PyTorch's threads would spin against one another.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)
