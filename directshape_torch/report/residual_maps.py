"""What a refinement looks at, pixel by pixel: photometric and silhouette residuals of one car, as coloured pictures.

A map is made anew from the state: all pixels of the car's window, not only the sampled ones, and without the rules by
which the energy leaves pixels out, but for other instances that lie in front.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.projection import warp_to_right
from directshape_torch.image.grey_levels import grey_levels
from directshape_torch.image.interpolate import bilinear_at
from directshape_torch.refinement.ray_cast import cast
from directshape_torch.scene import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.silhouette import ZETA_BOUNDS, closest_approach_residual
from directshape_torch.visualize.drawing import Picture, Window, blue_white_red, pixel_grid

Floats = npt.NDArray[np.floating[Any]]

# A near car needs no ray for each of its pixels.
_MOST_COLUMNS = 240
# Two exposures differ by a few percent (as in the energy); more is a wrong place.
_GAIN_BOUNDS = (0.8, 1.25)
_FULL_COLOUR_GREY_LEVELS = 40.0
# Of a sure pixel: -log(0.01).
_FULL_COLOUR_SILHOUETTE = 4.6
_SPILLED, _UNFILLED = (np.array(c, dtype=np.float64) for c in ((255, 140, 0), (186, 60, 220)))
_DIM = 0.5


@torch.no_grad()
def residual_maps(
    frame: FrameBatch,
    prior: ShapePrior,
    T_cam_obj: Floats,  # (4, 4)
    code: Floats,  # (K,)
    window: Window,
    foreground: Floats | None,  # (H, W) probability of the car's mask, or None
    hidden: npt.NDArray[np.bool_],  # (H, W) pixels of other instances
    config: RefinerConfig,
) -> tuple[Floats, Floats | None]:
    """Both maps of a car in one state, over a grid of (h, w) pixels of its window.

    The photometric one is right minus left, grey levels, NaN where the car is not seen in both images; that of the
    silhouette is positive where the shape spills out of its mask, negative where it does not fill it, None without one.
    """
    grid = _grid(window)
    uv = grid.reshape(-1, 2)
    T, code_of_car = (torch.from_numpy(np.asarray(x))[None].to(prior.origin) for x in (T_cam_obj, code))
    ray_cam = rays_from_pixels(uv, frame.camera.K_left[0])
    seen = cast(prior, CarState.of(se3.inverse(T), code_of_car), torch.zeros_like(ray_cam[0]), ray_cam)
    out = torch.from_numpy(hidden)[uv[:, 1].long(), uv[:, 0].long()]
    photometric = _photometric(frame, uv, ray_cam, seen.depth, ~out, config.photometric.brightness != "none")
    silhouette = None
    if foreground is not None:
        p_fg = torch.from_numpy(foreground)[uv[:, 1].long(), uv[:, 0].long()].to(uv)
        focal, width_px = float(frame.camera.K_left[0, 0, 0]), config.stages[-1].contour_width_px
        zeta = min(max(focal / (max(float(T[0, 2, 3]), 0.1) * width_px), ZETA_BOUNDS[0]), ZETA_BOUNDS[1])
        residual = _silhouette(seen.closest_sdf, p_fg, zeta, config.silhouette.probability_floor)
        silhouette = torch.where(out, torch.zeros_like(p_fg), residual).reshape(grid.shape[:2]).numpy()
    return photometric.reshape(grid.shape[:2]).numpy(), silhouette


def _grid(window: Window) -> Tensor:
    return pixel_grid(window, min(window[2] - window[0], _MOST_COLUMNS))


def _photometric(
    frame: FrameBatch, uv: Tensor, ray_cam: Tensor, depth: Tensor, counts: Tensor, matches_brightness: bool
) -> Tensor:
    """Right minus left, grey levels, NaN where not seen."""
    camera, rig = frame.camera, frame.camera.disparity_field
    bias, vertical = (None, None) if rig is None else rig.offsets(uv)
    hit = depth.isfinite()
    warped = warp_to_right(ray_cam, depth.where(hit, 1.0), camera.K_right[0], camera.T_right_cam[0], bias, vertical)
    at = bilinear_at(grey_levels(frame.images_right)[0], warped.uv_right)
    left, right = bilinear_at(grey_levels(frame.images_left)[0], uv).value, at.value
    seen, gain = hit & counts & at.inside & warped.in_front, 1.0
    if matches_brightness and bool(seen.any()):
        gain = float((right[seen].sum() / left[seen].sum().clamp_min(1)).clamp(*_GAIN_BOUNDS))
    return torch.where(seen, right - gain * left, torch.full_like(right, torch.nan))


def _silhouette(closest_sdf: Tensor, p_fg: Tensor, zeta: float, floor: float) -> Tensor:
    """The residual with the sign of projection minus mask."""
    p_fg = p_fg.clamp(floor, 1 - floor)
    residual, _ = closest_approach_residual(closest_sdf, torch.full_like(p_fg, zeta), p_fg)
    return residual * torch.sign(torch.sigmoid(-zeta * closest_sdf) - p_fg)


def photometric_picture(image: Picture, window: Window, residual: Floats) -> Picture:
    """White where left and right agree, red where the right image is brighter, blue where it is darker."""
    colour = blue_white_red(residual, _FULL_COLOUR_GREY_LEVELS)
    return _uint8(np.where(np.isfinite(residual)[..., None], colour, _dimmed(image, window)))


def silhouette_picture(image: Picture, window: Window, residual: Floats) -> Picture:
    """Orange where the shape spills out of its mask, violet where it does not fill it, over the dimmed image."""
    strength = np.clip(np.abs(residual) / _FULL_COLOUR_SILHOUETTE, 0, 1)[..., None] ** 0.7
    tint = np.where(residual[..., None] > 0, _SPILLED, _UNFILLED)
    base = _dimmed(image, window)
    return _uint8(base + strength * (tint - base))


def _dimmed(image: Picture, window: Window) -> Floats:
    """The image at the pixels of a map, darker and grey, (h, w, 3)."""
    grid = _grid(window).long().numpy()
    grey = image[grid[..., 1], grid[..., 0]].mean(axis=-1, keepdims=True)
    return np.asarray(np.repeat(_DIM * grey, 3, axis=-1))


def _uint8(colours: Floats) -> Picture:
    return np.ascontiguousarray(np.round(np.clip(colours, 0, 255)).astype(np.uint8))
