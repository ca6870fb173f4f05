"""Which instance mask belongs to which detection, one to one in each image.

Left image: overlap of 2D boxes. Right image: overlap with the initial 3D box projected into it, never the instance
numbers of the file, which few tools share between the two images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.box3d import BOX_EDGES, box_corners
from directshape_torch.geometry.camera import project, rays_from_pixels, warp_to_right
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.scene import StereoCamera

MIN_OVERLAP = 0.3
# Two masks of one image that share more than this are the same object seen twice by the segmentation.
DUPLICATE_MASK_IOU = 0.5
_NEAR_PLANE_M = 0.5


@dataclass(frozen=True)
class MaskMatches:
    """Masks of B detections in one image.

    Attributes:
        mask_of_detection: (B,) index into the list of masks, -1 for none.
        overlap: (B,) the overlap of the matched boxes, 0 for none.
    """

    mask_of_detection: NDArray[np.int64]
    overlap: NDArray[np.float64]


def box_iou(
    boxes_a: NDArray[np.float64],  # (A, 4) u_min, v_min, u_max, v_max, pixels
    boxes_b: NDArray[np.float64],  # (B, 4)
) -> NDArray[np.float64]:  # (A, B)
    """Intersection over union of image boxes; boxes without an area overlap nothing.

    Example:
        >>> box_iou(np.array([[0.0, 0.0, 2.0, 2.0]]), np.array([[1.0, 0.0, 3.0, 2.0]])).round(3)
        array([[0.333]])
    """
    a, b = boxes_a.reshape(-1, 1, 4), boxes_b.reshape(1, -1, 4)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    intersection = np.clip(sides, 0, None).prod(axis=-1)
    area_a, area_b = (np.clip(box[..., 2:] - box[..., :2], 0, None).prod(axis=-1) for box in (a, b))
    union = area_a + area_b - intersection
    return np.asarray(np.divide(intersection, union, out=np.zeros_like(union), where=union > 0))


def match_one_to_one(
    overlap: NDArray[np.float64],  # (B, M)
    min_overlap: float = MIN_OVERLAP,
) -> MaskMatches:
    """The assignment of largest total overlap (Hungarian) that uses pairs of at least `min_overlap` only.

    Example:
        >>> match_one_to_one(np.array([[0.9, 0.8], [0.7, 0.1]])).mask_of_detection.tolist()
        [1, 0]
    """
    from scipy.optimize import linear_sum_assignment

    allowed = np.where(overlap >= min_overlap, overlap, 0.0)
    rows, columns = linear_sum_assignment(allowed, maximize=True)
    used = allowed[rows, columns] > 0
    index = np.full(len(overlap), -1, dtype=np.int64)
    value = np.zeros(len(overlap))
    index[rows[used]] = columns[used]
    value[rows[used]] = allowed[rows[used], columns[used]]
    return MaskMatches(index, value)


def match_masks(
    boxes_2d: NDArray[np.float64],  # (B, 4) in the image of the masks, pixels
    masks: Sequence[InstanceMask],
    further_boxes_2d: NDArray[np.float64] | None = None,  # (B, 4) a second opinion, NaN where there is none
    eligible: Sequence[bool] | None = None,
    min_overlap: float = MIN_OVERLAP,
) -> MaskMatches:
    """Match masks of one image to 2D boxes, by the larger of the overlaps with the file's box and the mask's own.

    The file's box (that of the 2D detector) may reach over parts that are hidden, as a 3D detector's box does; the
    mask's own box fits detectors whose boxes enclose what is visible. Either is evidence enough.

    Args:
        boxes_2d: where each detection is expected.
        masks: instances of one side.
        further_boxes_2d: another expectation for each detection; the larger overlap counts.
        eligible: which masks may be matched; default those of cars.
        min_overlap: pairs below are never made.
    """
    file_boxes, mask_boxes = (
        np.array([getattr(mask, name) for mask in masks], dtype=np.float64).reshape(-1, 4)
        for name in ("box", "mask_box")
    )
    expected = [boxes_2d] if further_boxes_2d is None else [boxes_2d, further_boxes_2d]
    overlaps = [np.nan_to_num(box_iou(a, b)) for a in expected for b in (file_boxes, mask_boxes)]
    overlap = np.maximum.reduce(overlaps)
    allowed = [mask.is_car for mask in masks] if eligible is None else eligible
    overlap[:, ~np.array(allowed, dtype=bool)] = 0.0
    return match_one_to_one(overlap, min_overlap)


def project_boxes(
    T_cam_obj: Tensor,  # (B, 4, 4)
    dimensions_hwl: Tensor,  # (B, 3) metres
    camera: StereoCamera,  # of one frame
    size_hw: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # (B, 4), (B, 4)
    """2D boxes around 3D boxes in the left and the right image, clipped to the image; no area where out of sight.

    The right one goes through the residual disparity field of the rig, if there is one. What is behind the camera is
    cut away 0.5 m in front of it.
    """
    points_cam = _visible_edge_ends(box_corners(T_cam_obj.double(), dimensions_hwl.double()))
    in_front = ~points_cam.isnan().any(dim=-1)
    points_cam = torch.where(in_front[..., None], points_cam, torch.ones_like(points_cam))
    K_left, K_right, T_right_cam = (x[0].double() for x in (camera.K_left, camera.K_right, camera.T_right_cam))
    uv_left = project(points_cam, K_left)
    field = camera.disparity_field
    offset = () if field is None else field.offsets(uv_left)
    right = warp_to_right(rays_from_pixels(uv_left, K_left), points_cam[..., 2], K_right, T_right_cam, *offset)
    return (
        _enclosing_box(uv_left, in_front, size_hw),
        _enclosing_box(right.uv_right, in_front & right.in_front, size_hw),
    )


def _visible_edge_ends(corners_cam: Tensor) -> Tensor:
    """Both ends of the 12 edges (B, 24, 3), moved along the edge onto the near plane; NaN for hidden edges."""
    start, end = (corners_cam[:, [edge[k] for edge in BOX_EDGES]] for k in (0, 1))

    def clipped(a: Tensor, b: Tensor) -> Tensor:
        z_a, z_b = a[..., 2:], b[..., 2:]
        share = (_NEAR_PLANE_M - z_a) / torch.where(z_b == z_a, torch.ones_like(z_a), z_b - z_a)
        crossing = a + share * (b - a)
        nothing = torch.full_like(a, float("nan"))
        return torch.where(z_a >= _NEAR_PLANE_M, a, torch.where(z_b >= _NEAR_PLANE_M, crossing, nothing))

    return torch.cat([clipped(start, end), clipped(end, start)], dim=1)


def _enclosing_box(uv: Tensor, valid: Tensor, size_hw: tuple[int, int]) -> NDArray[np.float64]:
    big = torch.full_like(uv, float("inf"))
    low = torch.where(valid[..., None], uv, big).amin(dim=1)
    high = torch.where(valid[..., None], uv, -big).amax(dim=1)
    limit = uv.new_tensor([size_hw[1] - 1, size_hw[0] - 1])
    low = torch.minimum(low.clamp(min=0), limit)
    high = torch.minimum(high.clamp(min=0), limit)
    return np.asarray(torch.cat([low, high], dim=-1).cpu().numpy())


def without_duplicates(masks: Sequence[InstanceMask], matched: Iterable[int]) -> list[int]:
    """Indices of the masks that belong to no detection and are no second mask of a matched car.

    Args:
        masks: instances of one side.
        matched: indices of those that belong to a detection.
    """
    taken = {int(index) for index in matched}
    rest = [index for index in range(len(masks)) if index not in taken]
    return [i for i in rest if not any(_mask_iou(masks[i], masks[k]) > DUPLICATE_MASK_IOU for k in taken)]


def _mask_iou(a: InstanceMask, b: InstanceMask) -> float:
    if box_iou(np.array([a.mask_box]), np.array([b.mask_box]))[0, 0] == 0.0:
        return 0.0
    in_a, in_b = a.probability > 0.5, b.probability > 0.5
    return float((in_a & in_b).sum() / max(1, (in_a | in_b).sum()))
