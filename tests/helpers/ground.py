"""Cars of which nothing is known but the ground that they stand on."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from directshape_torch.state.cars import CarBatch


def cars_on(normal: Tensor, offset: Tensor, count: int) -> CarBatch:
    """Cars of which nothing is known but the ground: (3,) and a number."""
    nothing, number = torch.zeros(count, 0), torch.zeros(count, dtype=torch.long)
    ground = {"ground_normal_cam": normal.expand(count, 3), "ground_offset": offset.expand(count)}
    others = {f.name: nothing for f in fields(CarBatch) if f.name not in ground}
    return CarBatch(**{**others, "num_detections": count, "detection_row": number, "frame_index": number}, **ground)
