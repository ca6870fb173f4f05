"""Picture of the estimates of rigs: the field with contours, the data, and the residual before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.visualize.drawing import BLACK, Picture, beside, blue_white_red, titled

if TYPE_CHECKING:
    from directshape_torch.rig.estimate import RigEstimate

_CONTOUR_STEP_PX = 0.25
_DOT_RADIUS_PX = 6


def draw_rigs(
    rigs: Sequence[RigEstimate],  # at least one
) -> Picture:  # (H, W, 3) RGB
    """One below the other: what was found in words, the field, the detections' offsets, less their own bias, before
    the field and after."""
    pictures = []
    for rig in rigs:
        offset = rig.rows[:, 3] - rig.detector.bias * rig.rows[:, 2]
        field = draw_disparity_field(rig.field, rig.rows[:, :2], offset)
        pictures.append(titled(field, str(rig)))
    return beside(pictures, below=True)


def draw_disparity_field(
    field: DisparityField,
    uv_left: Tensor,  # (P, 2) pixels of the data
    bias_px: Tensor,  # (P,) measured minus true disparity there
) -> Picture:  # (3 * (H + title), W, 3) RGB
    """The field, and where there are any data, these before it and after: blue negative, white zero, red positive."""
    values, after = _field_values(field), bias_px - field.bias(uv_left)
    most = max(float(np.abs(values).max()), float(bias_px.abs().quantile(0.9)) if len(bias_px) else 0.0)
    limit = max(0.5, math.ceil(2 * most) / 2)
    colours = f"blue -{limit:g} px, white 0, red +{limit:g} px; the grey line is drawn round the data"
    panels = [titled(_field_panel(field, values, limit), f"measured less true disparity: {colours}")]
    for name, data in (("before the field is taken off", bias_px), ("after", after)) if len(bias_px) else ():
        panels.append(titled(_data_panel(field, uv_left, data, limit), _summary(name, data)))
    return beside(panels, below=True)


def _field_values(field: DisparityField) -> NDArray[np.float64]:
    """The field at every fourth pixel, brought to full size; it is smooth."""
    width, height = field.size_wh
    u = torch.linspace(0, width - 1, max(width // 4, 2), dtype=torch.float64)
    v = torch.linspace(0, height - 1, max(height // 4, 2), dtype=torch.float64)
    uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    coarse = field.to(device="cpu", dtype=torch.float64).bias(uv).numpy()
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float64)


def _field_panel(field: DisparityField, values: NDArray[np.float64], limit: float) -> Picture:
    panel = blue_white_red(values, limit).astype(np.uint8)
    first, last = (math.floor(float(x) / _CONTOUR_STEP_PX) for x in (values.min(), values.max()))
    for step in range(first + 1, last + 1):
        level = step * _CONTOUR_STEP_PX
        outlines, _ = cv2.findContours((values >= level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        for outline in outlines:
            _draw_contour(panel, outline[:, 0], level)
    return _with_hull(panel, field)


def _draw_contour(panel: Picture, outline: NDArray[Any], level: float) -> None:
    """The outline less the parts that only follow the picture's border, with its level half-way up the picture."""
    height, width = panel.shape[:2]
    points = outline[((outline > 0) & (outline < np.array([width - 1, height - 1]))).all(axis=1)]
    panel[points[:, 1], points[:, 0]] = 0
    room = points[(points[:, 0] < width - 60) & (points[:, 1] > 16)]
    while len(room) > 40:
        place = room[np.abs(room[:, 1] - height // 2).argmin()]
        cv2.putText(panel, f"{level:.2f}", place.tolist(), cv2.FONT_HERSHEY_SIMPLEX, 0.45, BLACK, 1, cv2.LINE_AA)
        # Once more on the other side of a valley.
        room = room[np.abs(room[:, 0] - place[0]) > width // 3]


def _data_panel(field: DisparityField, uv_left: Tensor, values_px: Tensor, limit: float) -> Picture:
    width, height = field.size_wh
    panel = np.full((height, width, 3), 225, np.uint8)
    colours = blue_white_red(values_px.double().cpu().numpy(), limit).tolist()
    for place, colour in zip(uv_left.round().long().cpu().tolist(), colours, strict=True):
        cv2.circle(panel, place, _DOT_RADIUS_PX, colour, -1)
    return _with_hull(panel, field)


def _with_hull(panel: Picture, field: DisparityField) -> Picture:
    corners = field.hull_uv.round().int().cpu().numpy()[:, None]
    cv2.polylines(panel, [corners], True, (150, 150, 150), 2, cv2.LINE_AA)
    return panel


def _summary(name: str, values_px: Tensor) -> str:
    median = values_px.median()
    spread = float((values_px - median).abs().median())
    return f"{len(values_px)} cars, {name}: median {float(median):+.3f} px, MAD {spread:.3f} px"
