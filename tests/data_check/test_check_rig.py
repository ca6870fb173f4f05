"""Boxes and images that disagree are a warning that says by how many pixels, and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

import directshape_torch
from directshape_torch.data_check import check_rig as module
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.kitti_dataset import KittiStereoDataset

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


@pytest.mark.parametrize(("bias_px", "expected"), [(0.0, []), (1.5, ["rig_offset"])])
def test_a_field_that_the_cars_contradict(bias_px: float, expected: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The bundled frame is exact, so a field of 1.5 px is what is wrong; it has six cars."""
    monkeypatch.setattr(module, "FEWEST_CARS", 4)
    dataset = KittiStereoDataset(DEMO, DEMO / "training" / "label_2", DEMO / "training" / "masks")
    frame = dataset.load("000000").frame
    height, width = frame.sizes[0].tolist()
    matrices = (frame.camera.K_left[0], frame.camera.K_right[0], frame.camera.T_right_cam[0])
    field = DisparityField.constant(bias_px, (width, height), *matrices)
    found = module.check_rig(dataset.changed(ground="file", disparity_field=field), ["000000"])
    assert [finding.check for finding in found] == expected
    for finding in found:
        assert "m at 30 m" in finding.measured
        assert "--rig auto" in finding.cure
