"""This module computes the residuals of the energy for cars, pixel by pixel, as values, colours and pictures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.tables import Chosen, take_rows
from directshape_torch.observation.packing import Observation, pack_pixels
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rows import PixelSamples, Rows
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.term import Part, Prepared
from directshape_torch.visualize.drawing import Array, View, blue_white_red

WORST_SILHOUETTE = 4.6
"""This is -log 0.01, the cost of a pixel whose mask is certain and wrong."""
WORST_GREY_LEVELS = 30.0
"""Image differences from this value on have the full colour."""

_MOST_PIXELS = 8000
# A pixel whose mask is certain and right has about this cost.
_NOTHING_SILHOUETTE = 0.2
_LOST: tuple[int, int, int] = (110, 110, 110)
# The first colour shows a shape outside its mask, the second a mask that the shape does not fill.
_SPILLED, _UNFILLED = (np.array(c, dtype=np.float64) for c in ((255, 140, 0), (186, 60, 220)))
_DARK = np.array([40.0, 40.0, 40.0])


class PixelResiduals(NamedTuple):
    """A `PixelResiduals` has P pixels of one car with their residuals."""

    uv: NDArray[np.float64]  # (P, 2) full-resolution pixels
    value: NDArray[np.float64]  # (P,)
    lost: NDArray[np.bool_]  # (P,) whether there is nothing to compare, so that the cost is constant


class CarResiduals(NamedTuple):
    """A `CarResiduals` has the residuals of one car; a term that is absent has no pixels.

    Silhouette residuals are `-log` of the probability of the mask, positive where the shape is outside the mask and
    negative where it does not fill the mask; no ray is lost. Photometric residuals are right less left image, grey
    levels, averaged over the part of the neighbourhood on the car.
    """

    silhouette_left: PixelResiduals
    silhouette_right: PixelResiduals
    photometric: PixelResiduals


# These are the car of each pixel, its uv, its value and whether it is lost, for all cars.
_Pixels = tuple[Tensor, Tensor, Tensor, Tensor]


@torch.no_grad()
def car_residuals(stage: CarStage, pixels: Observation, prepared: Prepared) -> list[CarResiduals]:
    """Residuals of R cars at an observed state, in a stage that has begun with these pixels."""
    figures, masks = stage.figures(prepared), stage.problem.masks
    nothing = torch.zeros(0)
    parts: dict[str, _Pixels] = dict.fromkeys(
        CarResiduals._fields, (nothing, nothing.view(0, 2), nothing, nothing.bool())
    )
    for term, at in zip(stage.terms, figures.parts, strict=True):
        if term.names == CarResiduals._fields[:2]:
            for side, of_side in enumerate((pixels.left, pixels.right)):
                value = at.residual[..., 0][(masks.filled > 0) & (masks.side == side)[:, None]]
                signed = torch.where(of_side.foreground > 0.5, -value, value)
                parts[term.names[side]] = of_side.object_index, of_side.uv, signed, torch.zeros_like(value).bool()
    photometric, at_photometric = stage.photometric, stage.photometric_part(figures)
    if photometric is not None and at_photometric is not None:
        parts["photometric"] = _of_photometry(photometric, at_photometric, pixels.left)
    return [
        CarResiduals(*(_of_car(parts[name], car) for name in CarResiduals._fields))
        for car in range(len(prepared.state.code))
    ]


def _of_car(pixels: _Pixels, car: int) -> PixelResiduals:
    uv, value, lost = (x[pixels[0] == car].cpu().numpy() for x in pixels[1:])
    return PixelResiduals(uv.astype(np.float64), value.astype(np.float64), lost)


def _of_photometry(term: Photometric, at: Part[Surface], left: PixelSamples) -> _Pixels:
    fixed = term.pixel_set
    counted = fixed.rows.pixel_weight > 0
    weight = fixed.rows.neighbour_weight.movedim(0, -1)
    mean = (at.residual * weight).sum(dim=-1) / weight.sum(dim=-1).clamp_min(1)
    # A `Prepared` has the left pixels in their packed blocks.
    pixel = Rows.of_sorted(left.object_index, len(term.cars)).row.flatten()[fixed.prepared_place]
    car = fixed.blocks.owner[:, None].expand_as(counted)
    return car[counted], left.uv[pixel[counted]], mean[counted], ~at.anchor.usable[counted]


@torch.no_grad()
def residual_maps(
    loaded: LoadedFrame,
    prior: ShapePrior,
    config: RefinerConfig,
    rows: Tensor,  # (R,) detections that have a pose
    states: Iterable[tuple[Array, Array]],  # poses (R, 4, 4) and shapes (R, K)
) -> list[list[CarResiduals]]:
    """Residuals of R cars for each of the states, at pixels that are evenly spaced over their regions.

    Masks are from the detections; photometric pixels are from the car in the state.
    """
    sampling = replace(config.sampling, mode="uniform", mode_right="uniform", density=1.0, max_pixels=_MOST_PIXELS)
    # Residuals do not depend on weights, so there are maps of a run that was not fitted to the images too.
    config = replace(
        config,
        silhouette=replace(config.silhouette, weight=1.0),
        photometric=replace(config.photometric, weight=1.0),
        point_cloud=replace(config.point_cloud, weight=0.0),
        sampling=sampling,
    )
    frame, detections = loaded.frame, loaded.detections
    found: list[list[CarResiduals]] = []
    chosen = Chosen.where(torch.zeros(len(detections), dtype=torch.bool).index_fill(0, rows, True))
    with full_precision():
        of_all, inputs = DirectShapeRefiner(prior, config).problem(frame, detections)
        problem, start = of_all.of(chosen), take_rows(inputs, rows)
        pixels = pack_pixels(frame, detections, sampling).of(chosen)
        for state in states:
            T_cam_obj, code = (torch.from_numpy(np.asarray(x)).to(start.code) for x in state)
            prepared = problem.prepare(start._replace(T_obj_cam=se3.inverse(T_cam_obj), code=code))
            found.append(car_residuals(problem.begin(-1, prepared), pixels, prepared))
    return found


def silhouette_colours(values: PixelResiduals) -> NDArray[np.uint8]:
    """Colours (P, 3): orange where the shape is outside its mask, violet where it does not fill it, else dark."""
    strength = np.clip(np.abs(values.value) / WORST_SILHOUETTE, 0, 1)[:, None] ** 0.7
    return _uint8(_DARK + strength * (np.where(values.value[:, None] > 0, _SPILLED, _UNFILLED) - _DARK))


def photometric_colours(values: PixelResiduals) -> NDArray[np.uint8]:
    """Colours (P, 3): blue where the right image is darker, white on agreement, red where brighter, grey if lost."""
    colours = _uint8(blue_white_red(values.value, WORST_GREY_LEVELS))
    colours[values.lost] = _LOST
    return colours


def draw_residuals(view: View, residuals: CarResiduals, name: str, share: float = 1.0) -> None:
    """Draw one kind of residuals as squares on its image, which is darkened; silhouettes only where they differ.

    The side of a square is `share` of the distance between pixels.
    """
    view.picture[...] = view.picture.mean(axis=2, keepdims=True) * 0.5 + 24
    values, uv = getattr(residuals, name), residuals.silhouette_left.uv
    if name != "photometric":
        values = PixelResiduals(*(x[np.abs(values.value) > _NOTHING_SILHOUETTE] for x in values))
    colours = (photometric_colours if name == "photometric" else silhouette_colours)(values)
    apart_px = float(np.ceil(np.sqrt(np.prod(np.ptp(uv, axis=0) + 1) / len(uv)))) if len(uv) else 1.0
    half = 0.5 * max(share * apart_px * view.from_image[0, 0], 2.0)
    for place, colour in zip(view.places(values.uv), colours.tolist(), strict=True):
        first, last = np.floor(place - half + 0.5), np.ceil(place + half - 0.5)
        cv2.rectangle(view.picture, first.astype(int).tolist(), last.astype(int).tolist(), colour, -1)


def _uint8(colours: Array) -> NDArray[np.uint8]:
    return np.asarray(np.round(np.clip(colours, 0, 255)).astype(np.uint8))
