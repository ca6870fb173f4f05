"""This module turns boxes as detectors write them, (N, 7) numbers or (N, 8, 3) corners, into poses and back.

| format | frame | location | sizes | heading |
|---|---|---|---|---|
| `kitti` | camera | bottom centre | h w l, as in label files | 0 along x (right), -pi/2 along z (forward) |
| `mmdet3d_camera` | camera | bottom centre | l h w | as KITTI |
| `opencv` | camera | centre | l w h | as KITTI |
| `mmdet3d_lidar` | LiDAR | bottom centre | l w h | 0 along x (forward), pi/2 along y (left) |
| `openpcdet` | LiDAR | centre | l w h (dx dy dz) | as `mmdet3d_lidar` |
| `nuscenes` | LiDAR, ego or global | centre | w l h | 0 along x, pi/2 along y |

Poses are in the frame of the left camera. Camera frames have x right, y down, z forward. In the other frames z is up,
and x depends on the tool: it points forward for `mmdet3d_lidar` and `openpcdet`, and to the right in nuScenes'
LIDAR_TOP. MMDetection3D means version 1.0 or later, where headings changed. Corners are in the order of each tool:
KITTI's devkit (and `opencv`), MMDetection3D's `corners`, OpenPCDet's `boxes_to_corners_3d`, nuScenes' `Box.corners()`,
transposed to (8, 3). KITTI's "ref" is a camera frame next to the left camera: `T_cam_boxes=camera.T_cam_ref`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import rotation_about_y
from directshape_torch.numerics.checks import check_rotation, check_rows, check_shape
from directshape_torch.numerics.conversion import Given, as_floating
from directshape_torch.numerics.full_precision import in_full_precision

BoxFormat = Literal["kitti", "mmdet3d_camera", "mmdet3d_lidar", "openpcdet", "nuscenes", "opencv"]
# Headings that were added up may exceed one turn; headings in degrees mostly exceed two.
_MOST_TURNS = 2
# Corners that were rounded to centimetres are within this distance of a box; corners in a wrong order are not.
_CORNER_TOLERANCE_M = 0.05
# These are the axes of the object frame (x forward, y down, z left) in a box frame (x forward, y left, z up).
_OBJ_IN_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
# Boxes lean by less than the angle of this cosine, because no camera on a car leans by 60 degrees.
_LEAST_UPRIGHT = 0.5
# A corner is its signs along the object's x, y and z: 1 at the front, the ground, the left of travel. OpenPCDet has
# KITTI's order.
_DEVKIT = ((1, 1, 1), (1, 1, -1), (-1, 1, -1), (-1, 1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1), (-1, -1, 1))
_MMDET3D_CAMERA = ((-1, -1, -1), (-1, -1, 1), (-1, 1, 1), (-1, 1, -1), (1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1))
_MMDET3D_LIDAR = ((-1, 1, -1), (-1, -1, -1), (-1, -1, 1), (-1, 1, 1), (1, 1, -1), (1, -1, -1), (1, -1, 1), (1, 1, 1))
_NUSCENES = ((1, -1, 1), (1, -1, -1), (1, 1, -1), (1, 1, 1), (-1, -1, 1), (-1, -1, -1), (-1, 1, -1), (-1, 1, 1))


@dataclass(frozen=True)
class BoxForm:
    """A `BoxForm` says how a tool writes boxes.

    Attributes:
        sizes: order of height, width and length.
        raised: share of the height by which the location lies above the bottom.
        upright: whether z is up and headings turn about it; else the axes are a camera's, and they turn about y, down.
        corners: signs of the corners along the object's axes.
        frame: axes of the frame, in words.
        heading: meaning of the heading, in words.
        heading_of_right: heading of a car that drives to the right of a camera that looks ahead, radians.
    """

    sizes: str
    raised: float
    upright: bool
    corners: tuple[tuple[int, int, int], ...]
    frame: str
    heading: str
    heading_of_right: float = 0.0

    @property
    def place(self) -> str:
        """The point of a box that its location gives, in words."""
        return "the centre of the box" if self.raised else "the centre of the box's bottom face"

    @property
    def order(self) -> str:
        """The names of the three sizes, in order."""
        names = {"h": "height", "w": "width", "l": "length"}
        return ", ".join(names[size] for size in self.sizes)


_CAMERA = "x right, y down, z forward, metres, in the frame of the rectified left camera"
_LIDAR = "x forward, y left, z up, metres, in the frame of the LiDAR that T_cam_boxes takes to the left camera"
_UP = "z up, metres, in the frame that T_cam_boxes takes to the left camera"
_ABOUT_Y = (
    "in radians about the y axis, 0 where the car drives along +x (right), -pi/2 where it drives along +z (ahead)"
)
_ABOUT_Z = "in radians about the z axis, 0 where the car drives along +x, pi/2 where it drives along +y"
_FORMS: dict[str, BoxForm] = {
    "kitti": BoxForm("hwl", 0.0, False, _DEVKIT, _CAMERA, f"rotation_y {_ABOUT_Y}"),
    "mmdet3d_camera": BoxForm("lhw", 0.0, False, _MMDET3D_CAMERA, _CAMERA, f"yaw {_ABOUT_Y}"),
    "mmdet3d_lidar": BoxForm("lwh", 0.0, True, _MMDET3D_LIDAR, _LIDAR, f"yaw {_ABOUT_Z}", -math.pi / 2),
    "openpcdet": BoxForm("lwh", 0.5, True, _DEVKIT, _LIDAR, f"heading {_ABOUT_Z}", -math.pi / 2),
    "nuscenes": BoxForm("wlh", 0.5, True, _NUSCENES, _UP, f"yaw {_ABOUT_Z}"),
    "opencv": BoxForm("lwh", 0.5, False, _DEVKIT, _CAMERA, f"heading {_ABOUT_Y}"),
}


@in_full_precision
def boxes_to_poses(
    boxes: Given,  # (N, 7) x, y, z, three sizes, heading; or (N, 8, 3) corners; metres and radians
    convention: BoxFormat,
    T_cam_boxes: Given | None = None,  # (4, 4) or (N, 4, 4), from the frame of the boxes to the left camera
) -> tuple[Tensor, Tensor]:
    """`T_cam_obj` (N, 4, 4) and heights, widths and lengths (N, 3) of boxes in a format of this module.

    Boxes may be an array or a list. The poses are float64 where the boxes are, else float32, also for half precision: a
    box from a network in bfloat16 at 20 m is known to 6 cm, but is not rounded again.

    Raises:
        InputError: an unknown convention, another shape, a frame with z up without `T_cam_boxes`, or corners that
            make no box in the convention's order.

    Examples:
        >>> T_cam_obj, hwl = boxes_to_poses(torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.6, 4.0, 0.3]]), "kitti")
        >>> hwl
        tensor([[1.5000, 1.6000, 4.0000]])
    """
    form, boxes = box_form(convention), as_floating(boxes)
    if not isinstance(boxes, Tensor) or boxes.ndim != 3:
        check_shape("boxes", boxes, ("N", 7), _cure_of_shape(boxes, convention), "floating")
        T_boxes_obj, hwl = _from_numbers(boxes, form)
    else:
        check_shape("boxes", boxes, ("N", 8, 3), kind="floating")
        T_boxes_obj, hwl = _from_corners(boxes, form, convention)
    T = _to_camera(T_cam_boxes, convention, T_boxes_obj)
    return (T_boxes_obj if T is None else T @ T_boxes_obj), hwl


@in_full_precision
def poses_to_boxes(
    T_cam_obj: Tensor,  # (N, 4, 4), origin under the middle of the box
    dimensions_hwl: Tensor,  # (N, 3) metres
    convention: BoxFormat,
    T_cam_boxes: Given | None = None,  # (4, 4) or (N, 4, 4), from the frame of the boxes to the left camera
) -> Tensor:
    """Boxes (N, 7) in a format of this module, which keep only the heading of the rotation.

    Raises:
        InputError: an unknown convention, or a frame with z up without `T_cam_boxes`.

    Examples:
        >>> T_cam_obj, hwl = boxes_to_poses(torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.6, 4.0, 0.3]]), "kitti")
        >>> poses_to_boxes(T_cam_obj, hwl, "opencv")
        tensor([[ 1.0000,  0.8500, 20.0000,  4.0000,  1.6000,  1.5000,  0.3000]])
    """
    form = box_form(convention)
    T = _to_camera(T_cam_boxes, convention, T_cam_obj)
    T_boxes_obj = T_cam_obj if T is None else se3.inverse(T) @ T_cam_obj
    up = -T_boxes_obj[:, :3, 1]
    location = T_boxes_obj[:, :3, 3] + form.raised * dimensions_hwl[:, :1] * up
    forward = T_boxes_obj[:, :3, 0]
    heading = torch.atan2(forward[:, 1] if form.upright else -forward[:, 2], forward[:, 0])
    sizes = dimensions_hwl[:, ["hwl".index(size) for size in form.sizes]]
    return torch.cat([location, sizes, heading[:, None]], dim=1)


def box_form(convention: str) -> BoxForm:
    """The `BoxForm` of a convention.

    Raises:
        InputError: an unknown convention.
    """
    if not isinstance(convention, str) or convention not in _FORMS:
        cure = "bring boxes of another kind into one of these, or give Detections poses T_cam_obj and dimensions_hwl"
        raise InputError("convention", f"one of {', '.join(get_args(BoxFormat))}", repr(convention), cure)
    return _FORMS[convention]


def check_upright(T_cam_boxes: Tensor, convention: BoxFormat) -> None:
    """Raise `InputError` where a motion (4, 4) or (N, 4, 4) to the camera tilts boxes by more than 60 degrees."""
    form = box_form(convention)
    axis, name, sign = (2, "z", 1.0) if form.upright else (1, "y", -1.0)
    R = T_cam_boxes.detach().reshape(-1, 4, 4)[:, :3, :3]
    leans = -sign * R[:, 1, axis] < _LEAST_UPRIGHT
    expected = (
        f"the motion from the frame of {convention!r} boxes ({form.frame.split(', metres')[0]}) to the left camera "
        f"(x right, y down, z forward), which takes their {name} axis {'up' if form.upright else 'down'}"
    )
    cure = "give camera_from_boxes, not its inverse boxes_from_camera, with the camera's axes"
    check_rows("T_cam_boxes", leans, R, expected, cure)


def _cure_of_shape(boxes: object, convention: str) -> str:
    order = f"give x, y, z, {box_form(convention).order} and heading, or corners (N, 8, 3)"
    if isinstance(boxes, Tensor) and boxes.ndim == 2 and boxes.shape[1] > 7:
        return f"{order}; leave out velocities and scores: boxes[:, :7]"
    return order


def _to_camera(T_cam_boxes: Given | None, convention: str, like: Tensor) -> Tensor | None:
    if T_cam_boxes is None:
        if not _FORMS[convention].upright:
            return None
        nuscenes = "take it from the calibrated_sensor entries of LiDAR and camera (and ego_pose for global boxes)"
        kitti = "with KITTI's calibration camera.T_cam_ref @ R0_rect @ Tr_velo_to_cam, as (4, 4) each"
        raise InputError(
            "T_cam_boxes",
            f"the rigid motion camera_from_lidar, (4, 4): {convention!r} boxes are not in the camera frame",
            "None",
            nuscenes if convention == "nuscenes" else kitti,
        )
    T_cam_boxes = as_floating(T_cam_boxes)
    given = tuple(T_cam_boxes.shape) if isinstance(T_cam_boxes, Tensor) else ()
    shape = given if given in ((4, 4), (1, 4, 4)) else (len(like), 4, 4)
    check_shape("T_cam_boxes", T_cam_boxes, shape, "give one motion, or one for each box", "floating")
    check_rotation("T_cam_boxes", T_cam_boxes.reshape(-1, 4, 4))
    return T_cam_boxes.to(like)


def _from_numbers(boxes: Tensor, form: BoxForm) -> tuple[Tensor, Tensor]:
    location, sizes, heading = boxes[:, :3], boxes[:, 3:6], boxes[:, 6]
    cure = "turn degrees into radians: torch.deg2rad(heading)"
    expected = f"headings in radians, which are within {_MOST_TURNS} turns"
    check_rows("boxes", heading.detach().abs() > _MOST_TURNS * 2 * math.pi, boxes.detach(), expected, cure)
    hwl = sizes[:, [form.sizes.index(size) for size in "hwl"]]
    if form.upright:
        turn = rotation_about_y(-heading)  # a turn about y is one about z the other way, with y and z exchanged
        R = boxes.new_tensor(_OBJ_IN_UPRIGHT) @ turn
    else:
        R = rotation_about_y(heading)
    bottom = location + form.raised * hwl[:, :1] * R[:, :, 1]
    return se3.from_rotation_translation(R, bottom), hwl


def _half_edges(corners: Tensor, form: BoxForm) -> tuple[Tensor, Tensor, Tensor]:
    """Half edges (N, 3, 3) of corners (N, 8, 3), distances (N,) of the corners from a box, and which (N,) are wrong.

    Rows of the half edges are along the object's x, y and z. Distances are in metres. Corners are wrong where they make
    no box that stands upright.
    """
    sign = corners.new_tensor(form.corners)
    half = torch.einsum("nci,ck->nki", corners, sign) / 8
    error = (corners - corners.mean(dim=1, keepdim=True) - sign @ half).norm(dim=-1).amax(dim=1)
    askew = (half @ half.mT / half.square().sum(dim=(1, 2), keepdim=True)).triu(1).abs().amax(dim=(1, 2))
    left_handed = torch.linalg.det(half.double()) < 0
    # The order of another tool turns a box by right angles into another box, which mostly lies on its side.
    height = half[:, 1] if not form.upright else -half[:, 1]
    rises = height[:, 2 if form.upright else 1] / height.norm(dim=1)
    return half, error, (error > _CORNER_TOLERANCE_M) | (askew > 0.02) | left_handed | (rises < _LEAST_UPRIGHT)


def _cure_of_corners(corners: Tensor, convention: str) -> str:
    """Advice for corners (8, 3): the conventions whose order and frame they fit, else the right order in words."""
    others = [name for name, form in _FORMS.items() if not _half_edges(corners[None], form)[2].item()]
    if others:
        return f"they are in the order of {' or '.join(map(repr, others))}: give that convention"
    words = (("rear", "front"), ("top", "bottom"), ("right", "left"))
    order = [
        " ".join(pair[sign > 0] for pair, sign in zip(words, corner, strict=True))
        for corner in _FORMS[convention].corners
    ]
    return f"give them as {', '.join(order)}, as seen by the driver"


def _from_corners(corners: Tensor, form: BoxForm, convention: str) -> tuple[Tensor, Tensor]:
    centre = corners.mean(dim=1)
    half, error, wrong = _half_edges(corners, form)
    if wrong.any():
        row = int(wrong.int().argmax())
        got = f"corners {error[row]:.2f} m from a box, or of a box turned inside out or on its side, in row {row}"
        cure = _cure_of_corners(corners[row], convention)
        raise InputError("boxes", f"corners in the order of {convention!r}", got, cure)
    length_height_width = 2 * half.norm(dim=2)
    # Corners are rounded, so the nearest rotation is taken; it is NaN where corners are not finite or an edge has no
    # length.
    axes = (half / half.norm(dim=2, keepdim=True)).double().mT
    U, _, Vh = torch.linalg.svd(axes.nan_to_num(0, 0, 0))
    R = (U @ Vh + 0 * axes.sum(dim=(1, 2), keepdim=True)).to(corners)
    bottom = centre + half[:, 1]
    return se3.from_rotation_translation(R, bottom), length_height_width[:, [1, 2, 0]]
