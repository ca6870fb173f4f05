"""This module looks up values in stacks of images by joint coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.image.interpolate import bilinear_patch


def bilinear_with_gradient(
    images: Tensor,  # (F, H, W)
    frame_index: Tensor,  # (...), broadcastable to uv's leading axes
    uv: Tensor,  # (..., 2)
    sizes: Tensor | None = None,  # (F, 2) height and width without padding
) -> tuple[Tensor, Tensor, Tensor]:
    """Values (...), gradients (..., 2) and whether points are inside (...)."""
    height, width = images.shape[1:]
    last_row, last_column = (height - 1, width - 1) if sizes is None else (sizes - 1)[frame_index].unbind(-1)
    first = frame_index * (height * width)
    at = bilinear_patch(images.reshape(-1), first, width, uv[..., 0], uv[..., 1], last_column, last_row)
    return at.value, torch.stack([at.d_u, at.d_v], dim=-1), at.inside
