"""Gradients of whole refinements of the bundled frame reach all numbers of a box."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch import DirectShapeRefiner, PCAShapePrior, load_config
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.laboratory.scenes import load_scene

_STEP = 2.5e-7
# The settings are those as shipped but for few pixels, and without what is a constant of the derivatives.
SETTINGS = (
    "backward.mode=unroll",
    "sampling.min_pixels=150",
    "sampling.max_pixels=150",
    "acceptance.min_probability_better=0",
    "acceptance.min_probability_not_worse=0",
    "rig.disparity_sigma_px=0",
    "priors.detector_weight=0",
)


def test_all_seven_numbers_of_a_box_have_the_gradient_of_the_refinement() -> None:
    scene = load_scene()
    d = scene.detections.rows(torch.tensor([0]))
    # Clamping of masks has no gradient.
    left, right = (masks.dense().clamp(0.1, 0.9) for masks in (d.mask_left, d.mask_right))
    refiner = DirectShapeRefiner(PCAShapePrior.load_bundled().double(), load_config("default", SETTINGS))

    def output(by: Tensor) -> Tensor:
        """A number that depends on position, heading and shape of the car whose box is moved by (7,)."""
        T_cam_obj = pose_from_kitti(d.T_cam_obj[:, :3, 3] + by[:3], rotation_y_from_pose(d.T_cam_obj) + by[3])
        moved = replace(
            d, T_cam_obj=T_cam_obj, dimensions_hwl=d.dimensions_hwl + by[4:], mask_left=left, mask_right=right
        )
        result = refiner(scene.frame, moved)
        weight = torch.linspace(0.5, 1.0, result.code.shape[1], dtype=torch.float64)
        place = result.T_cam_obj[0, :3, 3].sum() + 2 * rotation_y_from_pose(result.T_cam_obj)[0]
        return place + 0.3 * (result.code[0] * weight).sum()

    by = torch.zeros(7, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(output(by), by)
    with torch.no_grad():
        steps = _STEP * torch.eye(7, dtype=torch.float64)
        numeric = torch.stack([(output(step) - output(-step)) / (2 * _STEP) for step in steps])
    assert found.abs().min() > 1e-3
    assert float(((found - numeric).abs() / numeric.abs()).median()) < 1e-4
    assert float(((found - numeric).abs() / numeric.abs()).max()) < 0.05
