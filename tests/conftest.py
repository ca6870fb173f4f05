"""Lets tests import `helpers`, and keeps random numbers the same from run to run."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)
