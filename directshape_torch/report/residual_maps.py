"""What a refinement looks at, pixel by pixel: photometric and silhouette residuals of one car, as coloured pictures.

A map is made anew from the state: all pixels of the car's window, not only the sampled ones, and without the rules by
which the energy leaves pixels out, but for other instances that lie in front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from directshape_torch.diagnosis.ray_cast import cast
from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.projection import warp_to_right
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.image.grey_levels import grey_levels
from directshape_torch.image.interpolate import bilinear_at
from directshape_torch.scene import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.silhouette import ZETA_BOUNDS, closest_approach_residual
from directshape_torch.visualize.drawing import Picture

Floats = npt.NDArray[np.floating[Any]]
Window = tuple[int, int, int, int]

# A near car needs no ray for each of its pixels.
_MOST_COLUMNS = 240
# Two exposures differ by a few percent (as in the energy); more is a wrong place.
_GAIN_BOUNDS = (0.8, 1.25)

FULL_COLOUR_GREY_LEVELS = 40.0
# Of a sure pixel: -log(0.01).
FULL_COLOUR_SILHOUETTE = 4.6

_RED, _BLUE, _WHITE = (np.array(c, dtype=np.float64) for c in ((214, 47, 39), (49, 87, 200), (245, 245, 245)))
_SPILLED, _UNFILLED = (np.array(c, dtype=np.float64) for c in ((255, 140, 0), (186, 60, 220)))
_DIM = 0.5


@dataclass(frozen=True)
class MapSettings:
    """Settings of the run that bear on the maps: the silhouette's softness, and brightness."""

    contour_width_px: float = 0.5
    probability_floor: float = 0.01
    matches_brightness: bool = True


@dataclass(frozen=True)
class ViewedPair:
    """A stereo pair as grey levels 0..255.

    Attributes:
        left, right: (1, H, W).
        camera: of this one frame.
    """

    left: Tensor
    right: Tensor
    camera: StereoCamera

    @classmethod
    def of_frame(cls, frame: FrameBatch) -> ViewedPair:
        return cls(grey_levels(frame.images_left), grey_levels(frame.images_right), frame.camera)


@dataclass(frozen=True)
class ResidualMaps:
    """Maps over a grid of (h, w) pixels of the car's window.

    Attributes:
        photometric: right minus left, grey levels; NaN where the car is not seen in both images.
        silhouette: positive where the shape spills out of its mask, negative where it does not fill it; None without
            a mask.
    """

    photometric: Floats
    silhouette: Floats | None


def pixel_grid(window: Window) -> Tensor:
    """Pixels (h, w, 2) that cover a window, at most 240 columns."""
    u0, v0, u1, v1 = window
    width, height = u1 - u0, v1 - v0
    # Counted in whole numbers: a range of float steps may end on the window's border, outside of the image.
    columns = min(width, _MOST_COLUMNS)
    rows = math.ceil(height * columns / width)
    u, v = u0 + torch.arange(columns) * (width / columns), v0 + torch.arange(rows) * (width / columns)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


@torch.no_grad()
def residual_maps(
    pair: ViewedPair,
    prior: ShapePrior,
    T_cam_obj: Floats,  # (4, 4)
    code: Floats,  # (K,)
    window: Window,
    foreground: Floats | None,  # (H, W) probability of the car's mask, or None
    hidden: npt.NDArray[np.bool_],  # (H, W) pixels of other instances
    settings: MapSettings,
) -> ResidualMaps:
    """Both maps of a car in one state."""
    grid = pixel_grid(window)
    uv = grid.reshape(-1, 2)
    T, code_of_car = (torch.from_numpy(np.asarray(x))[None].to(prior.origin) for x in (T_cam_obj, code))
    ray_cam = rays_from_pixels(uv, pair.camera.K_left[0])
    seen = cast(prior, CarState.of(se3.inverse(T), code_of_car), torch.zeros_like(ray_cam[0]), ray_cam)
    out = torch.from_numpy(hidden)[uv[:, 1].long(), uv[:, 0].long()]
    hit = seen.depth.isfinite()
    photometric = _photometric(pair, uv, ray_cam, seen.depth.where(hit, 1.0), hit & ~out, settings)
    silhouette = None
    if foreground is not None:
        p_fg = torch.from_numpy(foreground)[uv[:, 1].long(), uv[:, 0].long()].to(uv)
        zeta = _zeta(pair.camera, float(T[0, 2, 3]), settings)
        silhouette = torch.where(out, torch.zeros_like(p_fg), _silhouette(seen.closest_sdf, p_fg, zeta, settings))
    size = grid.shape[:2]
    return ResidualMaps(
        photometric.reshape(size).numpy(),
        None if silhouette is None else silhouette.reshape(size).numpy(),
    )


def _photometric(
    pair: ViewedPair, uv: Tensor, ray_cam: Tensor, depth: Tensor, seen: Tensor, settings: MapSettings
) -> Tensor:
    """Right minus left, grey levels, NaN where not seen."""
    camera = pair.camera
    rig = camera.disparity_field
    bias, vertical = (None, None) if rig is None else rig.offsets(uv)
    warped = warp_to_right(ray_cam, depth, camera.K_right[0], camera.T_right_cam[0], bias, vertical)
    at, left = bilinear_at(pair.right[0], warped.uv_right), bilinear_at(pair.left[0], uv).value
    right, seen = at.value, seen & at.inside & warped.in_front
    gain = 1.0
    if settings.matches_brightness and bool(seen.any()):
        gain = float((right[seen].sum() / left[seen].sum().clamp_min(1)).clamp(*_GAIN_BOUNDS))
    return torch.where(seen, right - gain * left, torch.full_like(right, torch.nan))


def _silhouette(closest_sdf: Tensor, p_fg: Tensor, zeta: float, settings: MapSettings) -> Tensor:
    """The residual with the sign of projection minus mask."""
    p_fg = p_fg.clamp(settings.probability_floor, 1 - settings.probability_floor)
    residual, _ = closest_approach_residual(closest_sdf, torch.full_like(p_fg, zeta), p_fg)
    return residual * torch.sign(torch.sigmoid(-zeta * closest_sdf) - p_fg)


def _zeta(camera: StereoCamera, depth_m: float, settings: MapSettings) -> float:
    zeta = float(camera.K_left[0, 0, 0]) / (max(depth_m, 0.1) * settings.contour_width_px)
    return min(max(zeta, ZETA_BOUNDS[0]), ZETA_BOUNDS[1])


def photometric_picture(image: Picture, window: Window, residual: Floats) -> Picture:
    """White where left and right agree, red where the right image is brighter, blue where it is darker.

    Args:
        image: (H, W, 3) left.
        window: of the car.
        residual: (h, w) grey levels, NaN where there is none.
    """
    known = np.isfinite(residual)
    share = np.clip(np.nan_to_num(residual) / FULL_COLOUR_GREY_LEVELS, -1, 1)[..., None]
    tint = np.where(share > 0, _RED, _BLUE)
    colour = _WHITE + np.abs(share) * (tint - _WHITE)
    return _uint8(np.where(known[..., None], colour, dimmed(image, window)))


def silhouette_picture(image: Picture, window: Window, residual: Floats) -> Picture:
    """Orange where the shape spills out of its mask, violet where it does not fill it, over the dimmed image."""
    strength = np.clip(np.abs(residual) / FULL_COLOUR_SILHOUETTE, 0, 1)[..., None] ** 0.7
    tint = np.where(residual[..., None] > 0, _SPILLED, _UNFILLED)
    base = dimmed(image, window)
    return _uint8(base + strength * (tint - base))


def dimmed(image: Picture, window: Window) -> Floats:
    """The image at the pixels of a map, darker and grey, (h, w, 3)."""
    grid = pixel_grid(window).long().numpy()
    grey = image[grid[..., 1], grid[..., 0]].mean(axis=-1, keepdims=True)
    return np.asarray(np.repeat(_DIM * grey, 3, axis=-1))


def _uint8(colours: Floats) -> Picture:
    return np.ascontiguousarray(np.round(np.clip(colours, 0, 255)).astype(np.uint8))
