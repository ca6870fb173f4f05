"""This module has fixtures of runs over a data set; `tests/conftest.py` imports them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from helpers.finished_run import FinishedRun, finished_run
from helpers.kitti_folder import write_data_set


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


SIX_FRAMES = tuple(f"{number:06d}" for number in range(6))


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
