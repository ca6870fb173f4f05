"""Masks that a row of the ablation may ask for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from directshape_torch.errors import InputError
from directshape_torch.io.instance_masks import InstanceMask, MaskSource, file_of_frame
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.mask_files import COCO_CAR_IDS, mask_source
from paper_tables.data_sets import DataSet
from paper_tables.settings import Masks


@dataclass(frozen=True)
class BoxMasks:
    """The 2D boxes of detections, filled: what is known of the left image without a segmentation.

    Attributes:
        detections: folder of result files.
    """

    detections: Path

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        objects = [o for o in read_objects(self._path(frame_id)) if o.type == "Car"]
        masks = []
        for o in objects:
            left, top, right, bottom = (round(edge) for edge in o.box_2d)
            mask = np.zeros(size_hw, dtype=np.bool_)
            mask[max(top, 0) : max(bottom + 1, 0), max(left, 0) : max(right + 1, 0)] = True
            if mask.any():
                (category,) = COCO_CAR_IDS
                masks.append(InstanceMask("left", o.line_number, category, True, o.box_2d, o.box_2d, mask, 1.0))
        return masks

    def files(self, frame_id: str) -> tuple[Path, ...]:
        return (self._path(frame_id),)

    def _path(self, frame_id: str) -> Path:
        return file_of_frame(self.detections, f"{frame_id}.txt")


@dataclass(frozen=True)
class LeftMasks:
    """The masks of the left images alone: the right silhouette is not compared.

    Attributes:
        both: masks of both images.
    """

    both: MaskSource

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        return [mask for mask in self.both.read(frame_id, size_hw) if mask.side == "left"]

    def files(self, frame_id: str) -> tuple[Path, ...]:
        return self.both.files(frame_id)


def masks_for(data_set: DataSet, detections: Path, wanted: Masks) -> MaskSource:
    """The masks that a row asks for.

    Raises:
        InputError: the data set has none of this kind.
    """
    if wanted == "boxes":
        return BoxMasks(detections)
    folder = data_set.masks_degraded if wanted == "degraded" else data_set.masks
    if folder is None:
        raise InputError("masks", f"{wanted} masks in {data_set.root}", "none", "give --masks DIR")
    source = mask_source(folder)
    return LeftMasks(source) if wanted == "left" else source
