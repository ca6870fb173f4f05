"""The start errors of the convergence experiment are what they claim, and successes are counted right."""

import math

import convergence_basin as script
import numpy as np
import torch

from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose, wrap_angle


def test_start_is_off_by_exactly_the_stated_error():
    place = torch.tensor([[1.0, 1.6, 20.0], [-4.0, 1.5, 9.0]], dtype=torch.float64)
    truth = pose_from_kitti(place, torch.tensor([0.3, 3.1], dtype=torch.float64))
    direction = torch.tensor([0.0, math.pi / 2], dtype=torch.float64)
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)
    start = script.perturbed(truth, direction, sign, 0.5, 10.0)
    shift = start[:, :3, 3] - place
    torch.testing.assert_close(shift, torch.tensor([[0.5, 0, 0], [0, 0, 0.5]], dtype=torch.float64))
    turn = wrap_angle(rotation_y_from_pose(start) - rotation_y_from_pose(truth))
    torch.testing.assert_close(torch.rad2deg(turn), torch.tensor([10.0, -10.0], dtype=torch.float64))


def test_successes_are_counted_per_cell():
    trials = [
        script.Trial(0.1, 2.0, 0.2, 3.0),  # both at their limits: success
        script.Trial(0.1, 2.0, 0.21, 0.0),
        script.Trial(0.1, 5.0, 0.0, 3.1),
        script.Trial(0.5, 2.0, 0.1, 1.0),
    ]
    table = script.success_table(trials, [0.1, 0.5], [2.0, 5.0])
    np.testing.assert_array_equal(table, [[0.5, 0.0], [1.0, np.nan]])
    text = script.markdown_table(table, [0.1, 0.5], [2.0, 5.0], 2)
    assert "| 0.1 m | 50 | 0 |" in text
