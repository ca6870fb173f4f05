"""Boxes of detectors are read in every convention, from one car at a known place written by hand."""

from __future__ import annotations

import math
from typing import get_args

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.box_formats import BoxFormat, boxes_to_poses, check_upright, poses_to_boxes

# LiDAR (x forward, y left, z up) 0.3 m above and 0.2 m behind the camera.
T_CAM_LIDAR = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, -0.3], [1, 0, 0, -0.2], [0, 0, 0, 1]], dtype=torch.float64)
# nuScenes' LIDAR_TOP: x to the right, y forward, z up.
T_CAM_TOP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -0.3], [0, 1, 0, -0.2], [0, 0, 0, 1]], dtype=torch.float64)
# 20 m ahead, 3 m to the left, 1.7 m below the camera, 4 m long, 1.6 m wide, 1.5 m high; driving ahead and a little to
# the left: by 0.2 radians.
HWL = [1.5, 1.6, 4.0]
KITTI_YAW = -math.pi / 2 - 0.2
WRITTEN: dict[BoxFormat, list[float]] = {
    "kitti": [-3.0, 1.7, 20.0, 1.5, 1.6, 4.0, KITTI_YAW],
    "mmdet3d_camera": [-3.0, 1.7, 20.0, 4.0, 1.5, 1.6, KITTI_YAW],
    "opencv": [-3.0, 0.95, 20.0, 4.0, 1.6, 1.5, KITTI_YAW],
    "mmdet3d_lidar": [20.2, 3.0, -2.0, 4.0, 1.6, 1.5, 0.2],
    "openpcdet": [20.2, 3.0, -1.25, 4.0, 1.6, 1.5, 0.2],
    "nuscenes": [-3.0, 20.2, -1.25, 1.6, 4.0, 1.5, math.pi / 2 + 0.2],
}
MOTION = {"mmdet3d_lidar": T_CAM_LIDAR, "openpcdet": T_CAM_LIDAR, "nuscenes": T_CAM_TOP}


def expected() -> torch.Tensor:
    yaw = torch.tensor([KITTI_YAW], dtype=torch.float64)
    return pose_from_kitti(torch.tensor([[-3.0, 1.7, 20.0]], dtype=torch.float64), yaw)


@pytest.mark.parametrize("convention", WRITTEN)
def test_every_convention_says_the_same_car(convention: BoxFormat) -> None:
    boxes = torch.tensor([WRITTEN[convention]], dtype=torch.float64)
    T_cam_obj, hwl = boxes_to_poses(boxes, convention, MOTION.get(convention))
    torch.testing.assert_close(T_cam_obj, expected(), atol=1e-9, rtol=0)
    assert hwl.tolist() == [HWL]
    again = poses_to_boxes(T_cam_obj, hwl, convention, MOTION.get(convention))
    torch.testing.assert_close(again, boxes, atol=1e-9, rtol=0)


@pytest.mark.parametrize("convention", WRITTEN)
def test_shapes_and_motions_are_refused_in_the_words_of_the_convention(convention: BoxFormat) -> None:
    order = {
        "kitti": "height, width, length",
        "mmdet3d_camera": "length, height, width",
        "opencv": "length, width, height",
        "mmdet3d_lidar": "length, width, height",
        "openpcdet": "length, width, height",
        "nuscenes": "width, length, height",
    }[convention]
    with pytest.raises(InputError, match=rf"shape \(N, 7\), got \(2, 9\); give x, y, z, {order} and heading, .*:7\]"):
        boxes_to_poses(torch.zeros(2, 9), convention, MOTION.get(convention))
    right_one = MOTION.get(convention, torch.eye(4).double())
    check_upright(right_one, convention)
    inverse = right_one.inverse() if convention in MOTION else T_CAM_LIDAR
    with pytest.raises(InputError, match=rf"T_cam_boxes: expected the motion from the frame of '{convention}' boxes"):
        check_upright(inverse, convention)


def test_lidar_boxes_need_the_motion_to_the_camera() -> None:
    boxes = torch.tensor([WRITTEN["nuscenes"]])
    with pytest.raises(
        InputError, match=r"T_cam_boxes: expected the rigid motion camera_from_lidar.* got None; .* calibr"
    ):
        boxes_to_poses(boxes, "nuscenes")
    with pytest.raises(InputError, match=r"got None; with KITTI's calibration camera.T_cam_ref @ R0_rect @ Tr_velo"):
        boxes_to_poses(boxes, "openpcdet")
    with pytest.raises(InputError, match="T_cam_boxes: expected shape"):
        boxes_to_poses(boxes, "nuscenes", T_CAM_TOP[:3])
    with pytest.raises(InputError, match="T_cam_boxes: expected rotations"):
        boxes_to_poses(boxes, "nuscenes", 2 * T_CAM_TOP)
    with pytest.raises(InputError, match=r"convention: expected one of kitti, .* got 'waymo'"):
        boxes_to_poses(boxes, "waymo")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"boxes: expected shape \(N, 7\)"):
        boxes_to_poses(boxes[:, :6], "kitti")


def test_a_pitched_sensor_gives_a_pitched_car_and_each_box_may_have_its_motion() -> None:
    c, s = math.cos(0.05), math.sin(0.05)
    pitch = torch.tensor([[1.0, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]], dtype=torch.float64)
    boxes = torch.tensor([WRITTEN["mmdet3d_lidar"]] * 2, dtype=torch.float64)
    motions = torch.stack([T_CAM_LIDAR, pitch @ T_CAM_LIDAR])
    T_cam_obj, hwl = boxes_to_poses(boxes, "mmdet3d_lidar", motions)
    torch.testing.assert_close(T_cam_obj[1], pitch @ T_cam_obj[0])
    torch.testing.assert_close(poses_to_boxes(T_cam_obj, hwl, "mmdet3d_lidar", motions), boxes)


@pytest.mark.parametrize("convention", get_args(BoxFormat))
def test_headings_in_degrees_are_refused(convention: BoxFormat) -> None:
    boxes = torch.tensor([[1.0, 1.0, 20.0, 1.5, 1.6, 4.0, 2.9], [1.0, 1.0, 20.0, 1.5, 1.6, 4.0, -90.5]])
    T_cam_boxes = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    with pytest.raises(InputError, match=r"boxes: expected headings in radians.* -90\.5\] in row 1; .*deg2rad"):
        boxes_to_poses(boxes, convention, T_cam_boxes)
    boxes_to_poses(boxes[:1], convention, T_cam_boxes)


def test_one_motion_may_have_the_axis_of_frames() -> None:
    boxes, T = torch.tensor([[1.0, 1.0, 20.0, 1.5, 1.6, 4.0, 2.9]]).expand(3, 7), torch.eye(4)
    T[0, 3] = 0.06
    expected = boxes_to_poses(boxes, "kitti", T)[0]
    assert boxes_to_poses(boxes, "kitti", T[None])[0].equal(expected)
    assert boxes_to_poses(boxes, "kitti", T.expand(3, 4, 4))[0].equal(expected)
