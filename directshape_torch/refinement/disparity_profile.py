"""How the curves of a `DisparityProfile` are made: the surface under a car's pixels, moved by offsets of the disparity.

The hits of a state are moved along their rays together, as if the whole visible surface had another disparity; shape
and contour stay.
"""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.config import PhotometricConfig
from directshape_torch.figures.disparity_profile import DisparityProfile, default_offsets
from directshape_torch.rows import CarSums, Rays
from directshape_torch.terms.photometric import Photometric, Surface, photometric_norm
from directshape_torch.terms.photometric_rows import PhotometricRows, residuals_at

MAX_PIXELS = 100
"""Pixels of each car that a curve is made of by default: enough for its shape at half the time of all."""

# Residuals of several offsets at once: 1 MB in single precision, for what does not stay in the caches takes longer.
_RESIDUALS_AT_ONCE = 250_000


@torch.no_grad()
def disparity_profile(
    term: Photometric | None,
    before: Surface | None,
    after: Surface | None,
    num_cars: int,
    like: Tensor,
    offsets_px: Tensor | None = None,
    max_pixels: int = MAX_PIXELS,
) -> DisparityProfile:
    """The curves of B cars at two states.

    Args:
        term: of a stage that has begun; None without photometry.
        before, after: the surface under its pixels at the input and at the end.
        num_cars: B.
        like: says the device.
        offsets_px: (n,) evenly spaced, 0 among them; default -3 to 3 px in steps of 0.25.
        max_pixels: of each car; of more, every second, third, ...
    """
    offsets = default_offsets(like) if offsets_px is None else offsets_px
    nan = torch.full((num_cars, len(offsets)), torch.nan, dtype=torch.float64, device=like.device)
    if term is None or before is None or after is None:
        return DisparityProfile(offsets, nan, nan, nan[:, 0])
    if not len(term.blocks.owner):
        return DisparityProfile(offsets, nan, nan, torch.zeros_like(nan[:, 0]))
    rows, place = _thinned(term, max_pixels)
    depth, on_surface = (
        torch.stack([x.flatten()[place], y.flatten()[place]])
        for x, y in ((before.depth, after.depth), (before.on_surface, after.on_surface))
    )
    per_px = -1 / (term.cars.K_right[:, 0, 0] * term.cars.T_right_cam[:, 0, 3])
    # A few offsets at a time where the pixels are many, so that memory stays that of the other evaluations.
    num_parts = -(-rows.neighbour_weight.numel() * 2 * len(offsets) // _RESIDUALS_AT_ONCE)
    costs = torch.cat(
        [
            shifted_costs(rows, term.config, depth, on_surface, per_px, some)
            for some in offsets.to(depth).tensor_split(num_parts)
        ],
        dim=1,
    )
    weight = (rows.neighbour_weight.sum(dim=0) * (rows.pixel_weight > 0)).sum(dim=1, dtype=torch.float64)
    num_pixels = (rows.pixel_weight > 0).sum(dim=1)
    means = (term.config.weight * cost.mT / weight.clamp_min(1)[:, None] for cost in costs)
    at_input, at_end = (mean.masked_fill((num_pixels == 0)[:, None], torch.nan) for mean in means)
    return DisparityProfile(offsets, at_input, at_end, num_pixels.to(torch.float64))


def _thinned(term: Photometric, max_pixels: int) -> tuple[PhotometricRows, Tensor]:
    """Every second, third, ... pixel of each car, one block of R places a car; and their places (B, R) in the set.

    A table rather than a list: how many pixels each car has, the host need not know.
    """
    fixed, num_cars = term.pixel_set, len(term.cars)
    sums = CarSums.of(fixed.blocks.owner, num_cars)
    counts = sums.sum(fixed.filled.sum(dim=1).to(torch.float64)).long()
    number = torch.arange(min(max_pixels, fixed.filled.numel()), device=counts.device)
    stride = (counts + max_pixels - 1) // max_pixels
    step = number * stride[:, None]
    # An empty place repeats the car's last pixel, which is not counted: another car's may be NaN.
    first = sums.first.clamp_max(len(fixed.filled) - 1)
    place = first[:, None] * fixed.filled.shape[1] + step.minimum((counts - 1).clamp_min(0)[:, None])
    rows = fixed.rows
    rays = Rays(
        torch.arange(num_cars, device=first.device), rows.rays.centre_cam[first], rows.rays.ray_cam.flatten(1)[:, place]
    )
    along_ray, along_baseline, left, weight, neighbours = (x.flatten(-2)[..., place] for x in rows[1:6])
    weight = torch.where(step < counts[:, None], weight, torch.zeros_like(weight))
    return PhotometricRows(rays, along_ray, along_baseline, left, weight, neighbours, rows.right.take(first)), place


@compilable(
    sizes={
        "owner": 0, "centre_cam": 0, "ray_cam": 1, "along_ray": 2, "along_baseline": 1, "intensity_left": 1,
        "pixel_weight": 0, "neighbour_weight": 1, "pixels": 0, "frame": 0, "to_full": 0, "crop": 0, "in_front": 0,
        "covering": 0, "depth": 1, "on_surface": 1, "per_px": 0, "offsets_px": 0,
    }
)  # fmt: skip
def shifted_costs(
    rows: PhotometricRows,
    config: PhotometricConfig,
    depth: Tensor,  # (S, B, R) of S surfaces, metres
    on_surface: Tensor,  # (S, B, R) bool
    per_px: Tensor,  # (B,) inverse depth that a pixel of disparity is worth
    offsets_px: Tensor,  # (n,)
) -> Tensor:
    """Costs (S, n, B), float64, of a row of pixels of each car, with the surfaces moved by offsets of the disparity."""
    inverse = 1 / depth[:, None] + offsets_px[:, None, None] * per_px[:, None]
    residual, comparable = residuals_at(rows, config, 1 / inverse)
    usable = on_surface[:, None] & comparable & (inverse > 0)
    rho = photometric_norm(config, torch.where(usable[..., None], residual, config.lost_grey_levels)).rho
    return (rho * (rows.pixel_weight[..., None] * rows.neighbour_weight.movedim(0, -1))).sum((-1, -2)).to(torch.float64)
