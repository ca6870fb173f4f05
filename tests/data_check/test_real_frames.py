"""No false alarm on rendered and on real frames."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from directshape_torch.data_check.check_dataset import check_dataset
from directshape_torch.io.open_dataset import LayoutName, open_dataset

DATA = os.environ.get("DIRECTSHAPE_DATA")
pytestmark = pytest.mark.skipif(DATA is None, reason="DIRECTSHAPE_DATA is not set")


@pytest.mark.parametrize(
    ("layout", "root", "detections", "masks"),
    [
        ("kitti", "rendered", "rendered/detections/mono", "rendered/masks_degraded"),
        ("kitti", "kitti", "kitti/detections/noisy_stereo", "kitti/training/masks"),
        ("tracking", "kitti/tracking/0005", "kitti/tracking/0005/detections/pointrcnn", "kitti/tracking/0005"),
    ],
)
def test_intact_frames(layout: LayoutName, root: str, detections: str, masks: str) -> None:
    base = Path(str(DATA))
    report = check_dataset(open_dataset(layout, base / root, base / detections, base / masks), 2)
    assert report.findings == ()
    assert report.num_checked == 2
    assert report.num_cars > 4
