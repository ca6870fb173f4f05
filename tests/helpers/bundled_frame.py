"""The folders of the bundled frame, the frame with its true boxes, and start boxes made of its masks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

from torch import Tensor

import directshape_torch
from directshape_torch import Detections, FrameBatch, MaskCrops
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.stereo_matching.disparity import with_disparity

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"
BOXES, LABELS, MASKS = DEMO / "detections" / "noisy_stereo", DEMO / "training" / "label_2", DEMO / "training" / "masks"


@cache
def with_true_boxes() -> LoadedFrame:
    """The six cars with their true boxes."""
    return open_dataset("kitti", DEMO, LABELS, MASKS).load("000000")


@cache
def demo() -> LoadedFrame:
    """The six cars with their true boxes, and frames that have been matched."""
    loaded = with_true_boxes()
    return replace(loaded, frame=with_disparity(loaded.frame))


def started(masks: MaskCrops | Tensor | None = None, frames: FrameBatch | None = None) -> Detections:
    loaded = demo()
    return Detections.from_masks(frames or loaded.frame, loaded.detections.mask_left if masks is None else masks)


def masks() -> Tensor:
    """The left masks (6, H, W) as bool."""
    return demo().detections.mask_left.dense() > 0.5


def with_mirror_image(row: int) -> tuple[Tensor, FrameBatch]:
    """The mask of a car and of six tenths of its mirror image on a wet road, and the frame."""
    frame, mask = demo().frame, masks()[row]
    assert frame.disparity is not None
    disparity = frame.disparity.clone()
    height = int(mask.any(dim=1).sum())
    for u in mask.any(dim=0).nonzero()[:, 0].tolist():
        bottom = int(mask[:, u].nonzero().max())
        for below in range(1, 6 * height // 10):
            mask[bottom + below, u] = mask[bottom - below, u]
            disparity[0, bottom + below, u] = disparity[0, bottom - below, u]
    return mask[None], replace(frame, disparity=disparity)
