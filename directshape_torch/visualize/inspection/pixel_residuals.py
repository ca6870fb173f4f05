"""What the sampled pixels of each car cost in a state of its trace: silhouettes of both images, photometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.terms.cars import CarState
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.term import Part
from directshape_torch.visualize.refinement_trace import RefinementTrace


class PixelResiduals(NamedTuple):
    """P pixels of one car with what the cost says of them."""

    uv: NDArray[np.float64]  # (P, 2) full-resolution pixels
    value: NDArray[np.float64]  # (P,)
    lost: NDArray[np.bool_]  # (P,) there is nothing to compare, and the pixel pays a constant


class CarResiduals(NamedTuple):
    """What the images say of one car; no pixels where there is no such term."""

    silhouette_left: PixelResiduals  # `-log` of the probability of the mask; a ray that passes by is not lost
    silhouette_right: PixelResiduals
    photometric: PixelResiduals  # right less left, grey levels, mean over the part of the neighbourhood on the car


# Of all cars: the place of the car of each pixel, and its uv, value and whether it is lost.
_Pixels = tuple[Tensor, Tensor, Tensor, Tensor]


@torch.no_grad()
def car_residuals(trace: RefinementTrace, number: int) -> dict[int, CarResiduals]:
    """Residuals for state `number` of the trace of each car that took part, by its row among the detections."""
    stage, state = trace.last_stage, CarState(*(x[trace.rows] for x in trace.states[number]))
    figures, masks = stage.figures(stage.problem.look(state)), stage.problem.masks
    nothing = torch.zeros(0)
    parts: dict[str, _Pixels] = dict.fromkeys(
        CarResiduals._fields, (nothing, nothing.view(0, 2), nothing, nothing.bool())
    )
    for term, at in zip(stage.terms, figures.parts, strict=True):
        if term.names == CarResiduals._fields[:2]:
            for side, pixels in enumerate((trace.pixels.left, trace.pixels.right)):
                value = at.residual[..., 0][(masks.filled > 0) & (masks.side == side)[:, None]]
                parts[term.names[side]] = pixels.object_index, pixels.uv, value, torch.zeros_like(value).bool()
        elif isinstance(term, Photometric):
            parts["photometric"] = _of_photometry(term, at)
    return {
        row: CarResiduals(*(_of_car(parts[name], place) for name in CarResiduals._fields))
        for place, row in enumerate(trace.rows.tolist())
    }


def _of_car(pixels: _Pixels, place: int) -> PixelResiduals:
    uv, value, lost = (x[pixels[0] == place].cpu().numpy() for x in pixels[1:])
    return PixelResiduals(uv.astype(np.float64), value.astype(np.float64), lost)


def _of_photometry(term: Photometric, at: Part) -> _Pixels:
    fixed, left = term.pixel_set, term.left
    assert left is not None, "a stage of all cars has all pixels"
    counted = fixed.rows.pixel_weight > 0
    weight = fixed.rows.neighbour_weight.movedim(0, -1)
    mean = (at.residual * weight).sum(dim=-1) / weight.sum(dim=-1).clamp_min(1)
    pixel = left.packed.row.flatten()[fixed.sight_place]
    car = fixed.blocks.owner[:, None].expand_as(counted)
    return car[counted], left.pixels.uv[pixel[counted]], mean[counted], ~Surface(*at.where).usable[counted]
