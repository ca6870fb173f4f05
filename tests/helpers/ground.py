"""This module has cars of which only the ground is known."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from directshape_torch.state.cars import CarBatch


def cars_on(normal: Tensor, offset: Tensor, count: int) -> CarBatch:
    """Cars of which only the ground is known, given by a normal (3,) and an offset."""
    nothing, number = torch.zeros(count, 0), torch.zeros(count, dtype=torch.long)
    ground = {"ground_normal_cam": normal.expand(count, 3), "ground_offset": offset.expand(count)}
    others = {f.name: nothing for f in fields(CarBatch) if f.name not in ground}
    return CarBatch(**{**others, "num_detections": count, "detection_row": number, "frame_index": number}, **ground)
