"""Which frames are judged, which detection belongs to which label, and which labels count."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.files.text_files import read_lines
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.numerics.checks import check_shape

MINIMUM_IOU_2D = 0.3


@dataclass(frozen=True)
class CountedLabels:
    """Which labels a comparison counts: the class, and what can fairly be asked of an image.

    Attributes:
        types: class names.
        minimum_height_px: of the 2D box.
        maximum_occluded: KITTI's level, 0 visible, 1 partly, 2 largely occluded.
        maximum_truncated: share of the object outside the image.
    """

    types: tuple[str, ...] = ("Car",)
    minimum_height_px: float = 25.0
    maximum_occluded: int = 1
    maximum_truncated: float = 0.5

    def counts(self, label: KittiObject) -> bool:
        """Whether a label counts.

        Examples:
            >>> from directshape_torch.files.text_files import read_lines
            >>> from directshape_torch.io.kitti_labels import parse_object
            >>> from directshape_torch.files.text_files import Line
            >>> line = Line(1, "Car 0 0 0 10 10 60 40 1.5 1.6 3.9 1 1.6 20 0", "")
            >>> CountedLabels().counts(parse_object("labels", line))
            True
        """
        height_px = label.box_2d[3] - label.box_2d[1]
        return (
            label.type in self.types
            and label.has_box_3d
            and height_px >= self.minimum_height_px
            and label.occluded <= self.maximum_occluded
            and label.truncated <= self.maximum_truncated
        )


def box_iou_2d(
    boxes_a: Tensor,  # (N, 4)
    boxes_b: Tensor,  # (M, 4)
) -> Tensor:
    """Intersection over union (N, M) of image boxes (u_min, v_min, u_max, v_max), as areas in pixels.

    Examples:
        >>> box_iou_2d(torch.tensor([[0.0, 0.0, 2.0, 2.0]]), torch.tensor([[1.0, 0.0, 3.0, 2.0]]))
        tensor([[0.3333]])
    """
    check_shape("boxes_a", boxes_a, ("N", 4))
    check_shape("boxes_b", boxes_b, ("M", 4))
    lower = torch.maximum(boxes_a[:, None, :2], boxes_b[None, :, :2])
    upper = torch.minimum(boxes_a[:, None, 2:], boxes_b[None, :, 2:])
    shared = (upper - lower).clamp_min(0).prod(dim=-1)
    area_a, area_b = ((b[:, 2:] - b[:, :2]).clamp_min(0).prod(dim=-1) for b in (boxes_a, boxes_b))
    union = area_a[:, None] + area_b[None] - shared
    return torch.where(union > 0, shared / torch.where(union > 0, union, torch.ones_like(union)), union * 0)


def match_by_iou(
    iou: Tensor,  # (N, M)
    minimum: float = MINIMUM_IOU_2D,
) -> list[int]:
    """For each of N rows the column it belongs to, or -1: pairs are taken by falling overlap, one to one.

    Equal overlaps are taken in row-major order, so the outcome is the same in every run.

    Raises:
        InputError: `iou` is no matrix, or `minimum` is not within (0, 1].

    Examples:
        >>> match_by_iou(torch.tensor([[0.9, 0.6], [0.8, 0.5], [0.1, 0.2]]))
        [0, 1, -1]
    """
    check_shape("iou", iou, ("N", "M"))
    if not 0 < minimum <= 1:
        raise InputError("minimum", "an overlap within (0, 1]", str(minimum))
    partner = [-1] * iou.shape[0]
    taken: set[int] = set()
    candidates = [
        (-value, row, column)
        for row, values in enumerate(iou.tolist())
        for column, value in enumerate(values)
        if value >= minimum
    ]
    for _, row, column in sorted(candidates):
        if partner[row] < 0 and column not in taken:
            partner[row] = column
            taken.add(column)
    return partner


def match_to_labels(detections: Sequence[KittiObject], labels: Sequence[KittiObject]) -> list[int]:
    """For each detection the index of its label, or -1: largest 2D overlap first, one to one.

    Labels of every class with a 3D box compete, so that a detection of a van is not given to the car behind it; which
    of the matched labels count is another question (`CountedLabels`).
    """
    known = [index for index, label in enumerate(labels) if label.has_box_3d]
    boxes = _image_boxes(detections), _image_boxes([labels[index] for index in known])
    return [known[column] if column >= 0 else -1 for column in match_by_iou(box_iou_2d(*boxes))]


def named_frames(frames: Iterable[str | int] | None, split: Path | str | None) -> tuple[str, ...] | None:
    """Ids of the frames that a caller names: by id or number, or in a file with one a line; None where by neither.

    Raises:
        InputError: both are given.
        DataFormatError: the file cannot be read.

    Examples:
        >>> named_frames([7, "000012", 7], None)
        ('000007', '000012')
    """
    if frames is not None and split is not None:
        raise InputError("frames", "frames or split", "both", "give one of them")
    if split is not None:
        frames = [line.text for line in read_lines(split)]
    if frames is None:
        return None
    return tuple(dict.fromkeys(f"{frame:06d}" if isinstance(frame, int) else frame for frame in frames))


def _image_boxes(objects: Sequence[KittiObject]) -> Tensor:
    return torch.tensor([o.box_2d for o in objects], dtype=torch.float64).reshape(-1, 4)
