"""The bundled frame with its true boxes, and start boxes made of its masks."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from torch import Tensor

import directshape_torch
from directshape_torch import Detections, FrameBatch, MaskCrops
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.stereo_matching.disparity import with_disparity

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


@lru_cache(maxsize=1)
def demo() -> LoadedFrame:
    """The six cars with their true boxes, and frames that have been matched."""
    loaded = open_dataset("kitti", DEMO, DEMO / "training" / "label_2", DEMO / "training" / "masks").load("000000")
    return replace(loaded, frame=with_disparity(loaded.frame))


def started(masks: MaskCrops | Tensor | None = None, frames: FrameBatch | None = None) -> Detections:
    loaded = demo()
    return Detections.from_masks(frames or loaded.frame, loaded.detections.mask_left if masks is None else masks)
