"""The small data set that other layouts are made of."""

from pathlib import Path

import pytest
from helpers.kitti_folder import write_data_set


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 000000 and 000001 in the layout of the object benchmark."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, ("000000", "000001"))
    return root
