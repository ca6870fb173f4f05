"""3D boxes as detectors write them, (N, 7) numbers or (N, 8, 3) corners, to poses in the camera frame and back.

| format | frame | location | sizes | heading |
|---|---|---|---|---|
| `kitti` | camera | bottom centre | h w l, as in label files | 0 along x (right), -pi/2 along z (forward) |
| `mmdet3d_camera` | camera | bottom centre | l h w | as KITTI |
| `opencv` | camera | centre | l w h | as KITTI |
| `mmdet3d_lidar` | LiDAR | bottom centre | l w h | 0 along x (forward), pi/2 along y (left) |
| `nuscenes` | LiDAR, ego or global | centre | w l h | 0 along x, pi/2 along y |

Camera frames have x right, y down, z forward; in the others z is up, and where x points is their own matter:
forward for `mmdet3d_lidar`, to the right in nuScenes' LIDAR_TOP. MMDetection3D is that of version 1.0 and later, where
headings changed. Corners are in the order of each tool: KITTI's devkit (and `opencv`), MMDetection3D's `corners`,
nuScenes' `Box.corners()`, transposed to (8, 3). KITTI's "ref" is a camera frame beside the left one:
`T_cam_boxes=camera.T_cam_ref`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import rotation_about_y
from directshape_torch.numerics.checks import check_rotation, check_shape

BoxFormat = Literal["kitti", "mmdet3d_camera", "mmdet3d_lidar", "nuscenes", "opencv"]
# Corners that were rounded to centimetres still make a box, those in another order do not.
_CORNER_TOLERANCE_M = 0.05
# Axes of the object frame (x forward, y down, z left) in those of a box whose z is up (x forward, y left).
_OBJ_IN_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
# Corners along the object's x, y and z: 1 at the front, the ground, the left of travel.
_DEVKIT = ((1, 1, 1), (1, 1, -1), (-1, 1, -1), (-1, 1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1), (-1, -1, 1))
_MMDET3D_CAMERA = ((-1, -1, -1), (-1, -1, 1), (-1, 1, 1), (-1, 1, -1), (1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1))
_MMDET3D_LIDAR = ((-1, 1, -1), (-1, -1, -1), (-1, -1, 1), (-1, 1, 1), (1, 1, -1), (1, -1, -1), (1, -1, 1), (1, 1, 1))
_NUSCENES = ((1, -1, 1), (1, -1, -1), (1, 1, -1), (1, 1, 1), (-1, -1, 1), (-1, -1, -1), (-1, 1, -1), (-1, 1, 1))


@dataclass(frozen=True)
class _Format:
    """How a tool writes boxes.

    Attributes:
        sizes: order of height, width and length.
        raised: share of the height by which the location lies above the bottom.
        upright: z is up; else a camera's axes.
        corners: signs along the object's axes.
    """

    sizes: str
    raised: float
    upright: bool
    corners: tuple[tuple[int, int, int], ...]


_FORMATS: dict[str, _Format] = {
    "kitti": _Format("hwl", 0.0, False, _DEVKIT),
    "mmdet3d_camera": _Format("lhw", 0.0, False, _MMDET3D_CAMERA),
    "mmdet3d_lidar": _Format("lwh", 0.0, True, _MMDET3D_LIDAR),
    "nuscenes": _Format("wlh", 0.5, True, _NUSCENES),
    "opencv": _Format("lwh", 0.5, False, _DEVKIT),
}


def boxes_to_poses(
    boxes: Tensor,  # (N, 7) x, y, z, three sizes, heading; or (N, 8, 3) corners; metres and radians
    convention: BoxFormat,
    T_cam_boxes: Tensor | None = None,  # (4, 4) or (N, 4, 4), from the frame of the boxes to the left camera
) -> tuple[Tensor, Tensor]:
    """`T_cam_obj` (N, 4, 4) and heights, widths and lengths (N, 3) of boxes in one of the formats above.

    Raises:
        InputError: an unknown convention, another shape, a frame with z up without `T_cam_boxes`, or corners that
            make no box in the convention's order.

    Examples:
        >>> T_cam_obj, hwl = boxes_to_poses(torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.6, 4.0, 0.3]]), "kitti")
        >>> hwl
        tensor([[1.5000, 1.6000, 4.0000]])
    """
    form = _format(convention)
    if not isinstance(boxes, Tensor) or boxes.ndim != 3:
        cure = "give x, y, z, three sizes and heading, or corners (N, 8, 3)"
        check_shape("boxes", boxes, ("N", 7), cure, "floating")
        T_boxes_obj, hwl = _from_numbers(boxes, form)
    else:
        check_shape("boxes", boxes, ("N", 8, 3), kind="floating")
        T_boxes_obj, hwl = _from_corners(boxes, form, convention)
    T = _to_camera(T_cam_boxes, convention, T_boxes_obj)
    return (T_boxes_obj if T is None else T @ T_boxes_obj), hwl


def poses_to_boxes(
    T_cam_obj: Tensor,  # (N, 4, 4), origin under the middle of the box
    dimensions_hwl: Tensor,  # (N, 3) metres
    convention: BoxFormat,
    T_cam_boxes: Tensor | None = None,  # (4, 4) or (N, 4, 4), from the frame of the boxes to the left camera
) -> Tensor:
    """Boxes (N, 7) in one of the formats above; of the rotation only the heading is left.

    Raises:
        InputError: an unknown convention, or a frame with z up without `T_cam_boxes`.

    Examples:
        >>> T_cam_obj, hwl = boxes_to_poses(torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.6, 4.0, 0.3]]), "kitti")
        >>> poses_to_boxes(T_cam_obj, hwl, "opencv")
        tensor([[ 1.0000,  0.8500, 20.0000,  4.0000,  1.6000,  1.5000,  0.3000]])
    """
    form = _format(convention)
    T = _to_camera(T_cam_boxes, convention, T_cam_obj)
    T_boxes_obj = T_cam_obj if T is None else se3.inverse(T) @ T_cam_obj
    up = -T_boxes_obj[:, :3, 1]
    location = T_boxes_obj[:, :3, 3] + form.raised * dimensions_hwl[:, :1] * up
    forward = T_boxes_obj[:, :3, 0]
    heading = torch.atan2(forward[:, 1] if form.upright else -forward[:, 2], forward[:, 0])
    sizes = dimensions_hwl[:, ["hwl".index(size) for size in form.sizes]]
    return torch.cat([location, sizes, heading[:, None]], dim=1)


def _format(convention: str) -> _Format:
    if not isinstance(convention, str) or convention not in _FORMATS:
        raise InputError("convention", f"one of {', '.join(get_args(BoxFormat))}", repr(convention))
    return _FORMATS[convention]


def is_z_up(convention: BoxFormat) -> bool:
    """Whether z is up in the frame of a format, and headings turn about it; else they turn about y, which is down."""
    return _format(convention).upright


def _to_camera(T_cam_boxes: Tensor | None, convention: str, like: Tensor) -> Tensor | None:
    if T_cam_boxes is None:
        if not _FORMATS[convention].upright:
            return None
        raise InputError(
            "T_cam_boxes",
            f"the rigid motion camera_from_lidar, (4, 4): {convention!r} boxes are not in the camera frame",
            "None",
            "KITTI: R0_rect @ Tr_velo_to_cam, then camera.T_cam_ref; nuScenes: from its calibrated_sensor entries",
        )
    shape = (4, 4) if isinstance(T_cam_boxes, Tensor) and T_cam_boxes.ndim == 2 else (len(like), 4, 4)
    check_shape("T_cam_boxes", T_cam_boxes, shape, "give one motion, or one for each box", "floating")
    check_rotation("T_cam_boxes", T_cam_boxes.reshape(-1, 4, 4))
    return T_cam_boxes.to(like)


def _from_numbers(boxes: Tensor, form: _Format) -> tuple[Tensor, Tensor]:
    location, sizes, heading = boxes[:, :3], boxes[:, 3:6], boxes[:, 6]
    hwl = sizes[:, [form.sizes.index(size) for size in "hwl"]]
    if form.upright:
        turn = rotation_about_y(-heading)  # about y one way is about z the other, with y and z exchanged
        R = boxes.new_tensor(_OBJ_IN_UPRIGHT) @ turn
    else:
        R = rotation_about_y(heading)
    bottom = location + form.raised * hwl[:, :1] * R[:, :, 1]
    return se3.from_rotation_translation(R, bottom), hwl


def _from_corners(corners: Tensor, form: _Format, convention: str) -> tuple[Tensor, Tensor]:
    sign = corners.new_tensor(form.corners)
    centre = corners.mean(dim=1)
    half = torch.einsum("nci,ck->nki", corners, sign) / 8  # half edges, rows along the object's x, y, z
    error = (corners - centre[:, None] - sign @ half).norm(dim=-1).amax(dim=1)
    askew = (half @ half.mT / half.square().sum(dim=(1, 2), keepdim=True)).triu(1).abs().amax(dim=(1, 2))
    left_handed = torch.linalg.det(half.double()) < 0
    # Another tool's order turns a box by right angles, which makes a box again: mostly one on its side.
    height = half[:, 1] if not form.upright else -half[:, 1]
    rises = height[:, 2 if form.upright else 1] / height.norm(dim=1)
    wrong = (error > _CORNER_TOLERANCE_M) | (askew > 0.02) | left_handed | (rises < 0.5)
    if wrong.any():
        row = int(wrong.int().argmax())
        got = f"corners {error[row]:.2f} m from a box, or of a box turned inside out or on its side, in row {row}"
        cure = "see the order of corners in directshape_torch.geometry.box_formats"
        raise InputError("boxes", f"corners in the order of {convention!r}", got, cure)
    length_height_width = 2 * half.norm(dim=2)
    # The nearest rotation, as corners are rounded; none of numbers that are not finite, or where an edge has no length.
    axes = (half / half.norm(dim=2, keepdim=True)).double().mT
    U, _, Vh = torch.linalg.svd(axes.nan_to_num(0, 0, 0))
    R = (U @ Vh + 0 * axes.sum(dim=(1, 2), keepdim=True)).to(corners)
    bottom = centre + half[:, 1]
    return se3.from_rotation_translation(R, bottom), length_height_width[:, [1, 2, 0]]
