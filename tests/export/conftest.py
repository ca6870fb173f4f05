"""The finished run that all tests of exports read."""

from __future__ import annotations

import pytest
from helpers.finished_run import FinishedRun, finished_run


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    return finished_run(tmp_path_factory.mktemp("finished"))
