"""This file lets tests import `helpers`, keeps random numbers the same in every run, and has runs that tests share."""

from __future__ import annotations

import shutil
from pathlib import Path

import hypothesis
import pytest
import torch
from helpers.finished_run import FinishedRun, finished_run
from helpers.kitti_folder import SIX_FRAMES, write_data_set

# The same examples in every run: a failure that comes and goes helps nobody.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None)
hypothesis.settings.load_profile("repeatable")
# Tests run in several processes; PyTorch's threads would spin against one another.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def shared_kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set in KITTI's folders that no test changes."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root)
    return root


@pytest.fixture(scope="session")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set with only the frames 000000 and 000001."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, ("000000", "000001"))
    return root


@pytest.fixture(scope="session")
def kitti_of_six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set with six frames, of which some are left when a run is ended."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, SIX_FRAMES)
    return root


@pytest.fixture
def kitti_copy(shared_kitti: Path, tmp_path: Path) -> Path:
    """A copy of the data set that a test may damage."""
    return Path(shutil.copytree(shared_kitti, tmp_path / "kitti"))


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """A finished run for reports and exports that no test changes."""
    return finished_run(tmp_path_factory.mktemp("finished"))
