"""This module makes calls of any number of cars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch


def with_cars(frames: Sequence[LoadedFrame], num_cars: int) -> tuple[FrameBatch, Detections]:
    """One call of exactly the given number of cars: repeated frames, the last one with only its first cars."""
    chosen: list[LoadedFrame] = []
    missing = num_cars
    while missing > 0:
        loaded = frames[len(chosen) % len(frames)]
        chosen.append(first_cars(loaded, min(missing, len(loaded.detections))))
        missing -= len(chosen[-1].detections)
    return collate(chosen)


def first_cars(loaded: LoadedFrame, count: int) -> LoadedFrame:
    """A frame with only its first cars; the others are absent, so they hide nothing."""
    return replace(loaded, detections=loaded.detections.rows(torch.arange(count)))
