"""Which instance mask belongs to which detection, one to one in each image.

Left image: overlap of 2D boxes. Right image: overlap with the initial 3D box projected into it, never the instance
numbers of the file, which few tools share between the two images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.scene_check.image_boxes import box_iou

MIN_OVERLAP = 0.3
# Two masks of one image that share more than this are the same object seen twice by the segmentation.
DUPLICATE_MASK_IOU = 0.5


@dataclass(frozen=True)
class MaskMatches:
    """Masks of B detections in one image.

    Attributes:
        mask_of_detection: (B,) index into the list of masks, -1 for none.
        overlap: (B,) the overlap of the matched boxes, 0 for none.
    """

    mask_of_detection: NDArray[np.int64]
    overlap: NDArray[np.float64]


def match_one_to_one(
    overlap: NDArray[np.float64],  # (B, M)
    min_overlap: float = MIN_OVERLAP,
) -> MaskMatches:
    """The assignment of largest total overlap (Hungarian) that uses pairs of at least `min_overlap` only.

    Examples:
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
