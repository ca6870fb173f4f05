"""This module draws estimates of rigs: the disparity field in bands, and the measurement at each car."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.visualize.drawing import BLACK, GROUND, Picture, beside, blue_white_red, draw_text, titled

if TYPE_CHECKING:
    from directshape_torch.rig.estimate import RigEstimate

_BAND_PX = 0.25
_DOT_RADIUS_PX = 7
_HULL = (120, 120, 120)


def draw_rigs(
    rigs: Sequence[RigEstimate],  # at least one
) -> Picture:  # (H, W, 3) RGB
    """Pictures of rigs, one below the other: the estimate in words, and the field with the offsets of cars."""
    pictures = []
    for rig in rigs:
        pictures.append(titled(draw_disparity_field(rig.field, rig.uv_of_cars, rig.offsets_of_cars()), str(rig)))
    return beside(pictures, below=True)


def draw_disparity_field(
    field: DisparityField,
    uv_left: Tensor,  # (P, 2) pixels of the data
    bias_px: Tensor,  # (P,) measured minus true disparity there
) -> Picture:  # (H + lines of text, W, 3) RGB
    """The field with a dot for each datum, which vanishes on agreement: blue negative, white zero, red positive."""
    width, height = field.size_wh
    v, u = torch.meshgrid(torch.arange(0, height, 4), torch.arange(0, width, 4), indexing="ij")
    coarse = field.to(device="cpu", dtype=torch.float64).bias(torch.stack([u, v], dim=-1).double()).numpy()
    # The field is smooth, so every fourth row and column is enough.
    values = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    most = max(float(np.abs(values).max()), float(bias_px.abs().quantile(0.9)) if len(bias_px) else 0.0)
    limit = max(0.5, math.ceil(2 * most) / 2)
    panel = blue_white_red(np.round(values / _BAND_PX) * _BAND_PX, limit).astype(np.uint8)
    cv2.polylines(panel, [field.hull_uv.round().int().cpu().numpy()[:, None]], True, _HULL, 2, cv2.LINE_AA)
    colours = blue_white_red(bias_px.double().cpu().numpy(), limit).tolist()
    for place, colour in zip(uv_left.round().long().cpu().tolist(), colours, strict=True):
        cv2.circle(panel, place, _DOT_RADIUS_PX, BLACK, -1, cv2.LINE_AA)
        cv2.circle(panel, place, _DOT_RADIUS_PX - 2, colour, -1, cv2.LINE_AA)
    lines = ["measured less true disparity, in bands of 0.25 px; the grey outline is round the data"]
    if len(bias_px):
        before, after = _summary(bias_px), _summary(bias_px - field.bias(uv_left))
        lines.append(f"a dot for each of {len(bias_px)} cars: {before} before the field is taken off, {after} after")
    return titled(np.concatenate([_scale(limit, width), panel]), *lines)


def _scale(limit: float, width: int) -> Picture:
    """A strip that explains the colours."""
    strip = np.full((30, width, 3), GROUND, np.uint8)
    for place, level in enumerate(np.linspace(-limit, limit, 5)):
        u = 8 + place * width // 5
        strip[5:25, u : u + 28] = blue_white_red(level, limit)
        draw_text(strip, f"{level:+.2f} px", (u + 36, 21), size=0.6, widest_px=width // 5 - 40)
    return strip


def _summary(values_px: Tensor) -> str:
    median = values_px.median()
    return f"median {float(median):+.2f} px, MAD {float((values_px - median).abs().median()):.2f} px"
