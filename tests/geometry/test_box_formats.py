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


def tools_corners(convention: BoxFormat) -> torch.Tensor:
    """Corners by each tool's own formula, from its own numbers."""
    x, y, z, *sizes, yaw = WRITTEN[convention]
    c, s = math.cos(yaw), math.sin(yaw)
    unravelled = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])[[0, 1, 3, 2, 4, 5, 7, 6]].double()
    about_y = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    about_z = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    at = torch.tensor([x, y, z], dtype=torch.float64)
    if convention == "mmdet3d_camera":
        local = (unravelled - torch.tensor([0.5, 1.0, 0.5])) * torch.tensor(sizes)
        return local.double() @ about_y.T + at
    if convention == "mmdet3d_lidar":
        local = (unravelled - torch.tensor([0.5, 0.5, 0.0])) * torch.tensor(sizes)
        return local.double() @ about_z.T + at
    if convention == "openpcdet":  # boxes_to_corners_3d of pcdet/utils/box_utils.py
        template = torch.tensor(
            [[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]]
        )
        local = template / 2 * torch.tensor(sizes)
        return local.double() @ about_z.T + at
    if convention == "nuscenes":
        w, length, h = sizes
        xs = length / 2 * torch.tensor([1.0, 1, 1, 1, -1, -1, -1, -1])
        ys = w / 2 * torch.tensor([1.0, -1, -1, 1, 1, -1, -1, 1])
        zs = h / 2 * torch.tensor([1.0, 1, -1, -1, 1, 1, -1, -1])
        return torch.stack([xs, ys, zs], 1).double() @ about_z.T + at
    h, w, length = HWL
    xs = length / 2 * torch.tensor([1.0, 1, -1, -1, 1, 1, -1, -1])
    ys = -h * torch.tensor([0.0, 0, 0, 0, 1, 1, 1, 1]) + (h / 2 if convention == "opencv" else 0.0)
    zs = w / 2 * torch.tensor([1.0, -1, -1, 1, 1, -1, -1, 1])
    return torch.stack([xs, ys, zs], 1).double() @ about_y.T + at


@pytest.mark.parametrize("convention", WRITTEN)
def test_corners_are_read_in_each_tools_own_order(convention: BoxFormat) -> None:
    corners = tools_corners(convention)[None]
    T_cam_obj, hwl = boxes_to_poses(corners, convention, MOTION.get(convention))
    torch.testing.assert_close(T_cam_obj, expected(), atol=1e-6, rtol=0)
    torch.testing.assert_close(hwl, torch.tensor([HWL]).double(), atol=1e-6, rtol=0)
    rounded, _ = boxes_to_poses((corners * 100).round() / 100, convention, MOTION.get(convention))
    torch.testing.assert_close(rounded, expected(), atol=0.02, rtol=0)


# The same order and axes, or corners that make another standing box in the other frame.
_BOXES_IN_BOTH = {
    *(("kitti", "opencv"), ("opencv", "kitti"), ("kitti", "nuscenes"), ("opencv", "nuscenes"), ("nuscenes", "kitti")),
    *(("nuscenes", "opencv"), ("mmdet3d_camera", "openpcdet"), ("mmdet3d_lidar", "mmdet3d_camera")),
}


@pytest.mark.parametrize(("written", "read"), [(a, b) for a in WRITTEN for b in WRITTEN])
def test_corners_of_another_tool_are_told_by_its_name(written: BoxFormat, read: BoxFormat) -> None:
    corners = tools_corners(written)[None]
    if written == read or (written, read) in _BOXES_IN_BOTH:
        boxes_to_poses(corners, read, MOTION.get(read))
        return
    with pytest.raises(InputError, match=f"in the order of '{read}'.*they are in the order of .*'{written}'"):
        boxes_to_poses(corners, read, MOTION.get(read))


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


def test_corners_in_another_order_are_refused() -> None:
    corners = tools_corners("kitti")[None]
    shuffled = corners[:, [0, 2, 1, 3, 4, 5, 6, 7]]
    with pytest.raises(InputError, match=r"boxes: expected corners in the order of 'kitti'.* in row 0"):
        boxes_to_poses(shuffled, "kitti")
    mirrored = corners[:, [4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(InputError, match="turned inside out"):
        boxes_to_poses(mirrored, "kitti")
    # A permutation of the axes makes a box again, with a car that lies on its side.
    others: tuple[tuple[BoxFormat, BoxFormat], ...] = (
        ("mmdet3d_camera", "kitti"),
        ("kitti", "mmdet3d_camera"),
        ("nuscenes", "mmdet3d_lidar"),
    )
    for written, read in others:
        with pytest.raises(InputError, match=rf"in the order of '{read}', got .* on its side, in row 0"):
            boxes_to_poses(tools_corners(written)[None], read, MOTION.get(written))


def test_corners_of_no_box_make_no_pose_and_leave_the_others_alone() -> None:
    box = tools_corners("kitti")
    T_cam_obj, _ = boxes_to_poses(torch.stack([torch.full_like(box, torch.nan), box, 0 * box + 5.0]), "kitti")
    assert T_cam_obj.isfinite().all(dim=2).all(dim=1).tolist() == [False, True, False]
    torch.testing.assert_close(T_cam_obj[1:2], expected(), atol=1e-6, rtol=0)


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
