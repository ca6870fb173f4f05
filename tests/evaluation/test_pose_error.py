"""Errors of boxes agree with hand-derived numbers."""

import math

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.evaluation.pose_error import pose_errors

TRUE = torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.7, 4.0, 0.2]], dtype=torch.float64)


def test_centre_is_that_of_the_box_not_of_its_bottom():
    # 0.2 m taller on the same ground: its centre is 0.1 m higher. With 0.3 m in x and 0.4 m in z: BEV 0.5 m.
    found = TRUE + torch.tensor([0.3, 0.0, 0.4, 0.2, 0.0, 0.0, 0.0], dtype=torch.float64)
    errors = pose_errors(found, TRUE)
    assert errors.centre_bev_m.item() == pytest.approx(0.5, abs=1e-12)
    assert errors.centre_m.item() == pytest.approx(math.sqrt(0.25 + 0.01), abs=1e-12)


def test_errors_along_and_across_the_ray_have_signs():
    # Seen at 3 m to the right and 4 m ahead, 0.5 m too far; then 0.5 m further to the right; 0.2 m too long.
    true = torch.tensor([[3.0, 1.6, 4.0, 1.5, 1.7, 4.0, 0.2]], dtype=torch.float64).repeat(2, 1)
    found = true + torch.tensor([[0.3, 0, 0.4, 0, 0, 0.2, 0], [0.4, 0, -0.3, 0, 0, 0.2, 0]], dtype=torch.float64)
    errors = pose_errors(found, true)
    assert errors.along_m.tolist() == pytest.approx([0.5, 0.0], abs=1e-12)
    assert errors.across_m.tolist() == pytest.approx([0.0, 0.5], abs=1e-12)
    assert errors.length_m.tolist() == pytest.approx([0.2, 0.2], abs=1e-12)


@pytest.mark.parametrize(
    ("turn_deg", "full", "axis"),
    [(0, 0, 0), (5, 5, 5), (-5, 5, 5), (90, 90, 90), (100, 100, 80), (175, 175, 5), (180, 180, 0), (350, 10, 10)],
)
def test_yaw_errors_modulo_360_and_180(turn_deg: float, full: float, axis: float):
    found = TRUE.clone()
    found[:, 6] += math.radians(turn_deg)
    errors = pose_errors(found, TRUE)
    assert errors.yaw_deg.item() == pytest.approx(full, abs=1e-9)
    assert errors.yaw_axis_deg.item() == pytest.approx(axis, abs=1e-9)


def test_wrong_shape_is_named():
    with pytest.raises(InputError, match=r"true_boxes: expected shape \(1, 7\)"):
        pose_errors(TRUE, torch.zeros(2, 7))
