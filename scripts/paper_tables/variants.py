"""Inputs of the ablation that a data set does not have itself: exposures, masks of boxes, simulated detections."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.instance_masks import InstanceMask, MaskSource, file_of_frame
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.mask_files import COCO_CAR_IDS, mask_source
from directshape_torch.io.stereo_dataset import LoadedFrame
from paper_tables.data_sets import DataSet
from paper_tables.rows import Exposure, Masks


class ExposedDataset(KittiStereoDataset):
    """A data set whose right images are seen through another camera; the rest is as in `KittiStereoDataset`."""

    def __init__(self, *args: Any, exposure: Exposure = "true", **options: Any) -> None:
        super().__init__(*args, **options)
        self.exposure = exposure

    def load(self, frame_id: str) -> LoadedFrame:
        loaded = super().load(frame_id)
        if self.exposure == "true":
            return loaded
        frame = loaded.frame
        return replace(loaded, frame=replace(frame, images_right=exposed(frame.images_right, self.exposure)))


def exposed(images: Tensor, exposure: Exposure) -> Tensor:
    """Images (F, 3, H, W) in [0, 1] with other brightness, in bytes as a camera gives them.

    Examples:
        >>> (255 * exposed(torch.full((1, 3, 1, 1), 100 / 255), "flatter")[0, 0]).round()
        tensor([[105.]])
    """
    return (255 * _CHANGES[exposure](images)).round().clamp(0, 255) / 255


def _vignetted(images: Tensor) -> Tensor:
    share = torch.linspace(0, 1, images.shape[-1], dtype=images.dtype, device=images.device)
    return images * (1 - 0.35 * share)


_CHANGES: dict[Exposure, Callable[[Tensor], Tensor]] = {
    "true": lambda x: x,
    "flatter": lambda x: 0.8 * x + 25 / 255,
    "vignetted": _vignetted,
}


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


# A stereo detector's errors on the ground, which `scale` multiplies.
DEPTH_SHARE, LATERAL_M, YAW_DEG = 0.025, 0.12, 5.0
VERTICAL_M, HEIGHT_SHARE = 0.05, 0.03
FOOTPRINT_SHARE = 0.03
MINIMUM_HEIGHT_PX = 25.0
_MAXIMUM_DEPTH_SHARE = 0.5

Labels = Mapping[str, Sequence[KittiObject]]


def simulated_lines(labels: Labels, scale: float, seed: int = 0) -> dict[str, list[str]]:
    """Result lines by frame for the cars at least 25 px high, best score first.

    Args:
        labels: by frame.
        scale: of the errors in the ground plane (depth, sideways, heading); 1 is a stereo detector.
        seed: of the random numbers.
    """
    return {frame_id: _frame_lines(frame_id, objects, scale, seed) for frame_id, objects in labels.items()}


def _frame_lines(frame_id: str, objects: Sequence[KittiObject], scale: float, seed: int) -> list[str]:
    generator = np.random.default_rng([seed, *frame_id.encode()])
    scored = []
    for label in objects:
        if label.type != "Car" or not label.has_box_3d:
            continue
        noise, _ = generator.standard_normal(8), generator.random()
        if label.box_2d[3] - label.box_2d[1] >= MINIMUM_HEIGHT_PX:
            scored.append(_result_line(label, noise.tolist(), scale))
    return [line for _, line in sorted(scored, reverse=True)]


def _result_line(label: KittiObject, noise: Sequence[float], scale: float) -> tuple[float, str]:
    depth, lateral, yaw, vertical, tall, wide, long, luck = noise
    x, y, z = label.location_ref
    share = scale * DEPTH_SHARE * depth
    factor = 1 + min(max(share, -_MAXIMUM_DEPTH_SHARE), _MAXIMUM_DEPTH_SHARE)
    distance = math.hypot(x, z)
    sideways = scale * LATERAL_M * lateral
    x, z = factor * x + sideways * z / distance, factor * z - sideways * x / distance
    y += VERTICAL_M * vertical
    height, width, length = label.hwl
    height *= 1 + HEIGHT_SHARE * tall
    width, length = width * (1 + FOOTPRINT_SHARE * wide), length * (1 + FOOTPRINT_SHARE * long)
    rotation_y = _wrapped(label.rotation_y + math.radians(scale * YAW_DEG * yaw))
    score = min(max(0.9 - distance / 100 + 0.15 * luck, 0.01), 0.99)
    numbers = [*label.box_2d, max(height, 0.5), width, length, x, y, max(z, 1.0), rotation_y]
    alpha = _wrapped(rotation_y - math.atan2(x, z))
    return score, f"Car -1 -1 {alpha:.4f} " + " ".join(f"{n:.4f}" for n in numbers) + f" {score:.4f}"


def _wrapped(angle: float) -> float:
    return math.remainder(angle, math.tau)


def write_detections(folder: Path, labels: Labels, scale: float, seed: int) -> Path:
    """Write result files into `folder/data`; returns the folder. Files that hold the same text stay as they are."""
    for frame_id, lines in simulated_lines(labels, scale, seed).items():
        path = folder / "data" / f"{frame_id}.txt"
        text = "".join(f"{line}\n" for line in lines)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)
    return folder
