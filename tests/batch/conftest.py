"""A tiny data set for the tests of runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.kitti_folder import write_data_set


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root)
    return root


@pytest.fixture
def root(source: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(source, tmp_path / "kitti"))
