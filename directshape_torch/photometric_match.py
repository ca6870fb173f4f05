"""How the photometric pixels of a stage match the right image at a state: values alone, for the figures of its end.

The iterations need derivatives at one disparity; what is asked once they are over needs none, at many disparities.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import PhotometricConfig
from directshape_torch.energy.photometric_pixels import PixelSet
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState, SeenSurface
from directshape_torch.residuals import robust
from directshape_torch.residuals.photometric import DSO_PATTERN
from directshape_torch.residuals.photometric_patch import patch_residual
from directshape_torch.residuals.photometric_profile import DisparityResiduals, residuals_on_lines

_CENTRE = DSO_PATTERN.index((0, 0))
# Of many offsets at once: 4 MB in single precision, for what does not stay in the caches takes longer.
_RESIDUALS_AT_ONCE = 1_000_000


class Match(NamedTuple):
    """R pixels and their N neighbourhood pixels compared at n offsets of the disparity."""

    residual: Tensor  # (n, R, N) grey levels
    usable: Tensor  # (n, R) bool: on the surface, inside the right image and not hidden there


def stage_pixels(term: PhotometricTerm) -> PixelSet:
    """The pixel set of the term's stage.

    Raises:
        RuntimeError: no stage has begun.
    """
    if term.fixed is None:
        raise RuntimeError("the photometric term has no pixel set before a stage begins: call begin_stage first")
    return term.fixed


def seen_surface(term: PhotometricTerm, projected: ProjectedState, rows: Tensor) -> SeenSurface:
    """The surface of a state under some rows (R,) of the term's pixel set."""
    return projected.left.seen_surface(stage_pixels(term).pixel_index[rows], term.config.min_ray_cosine)


def match(term: PhotometricTerm, rows: Tensor, seen: SeenSurface, offsets_px: Tensor) -> Match:
    """Some rows (R,) of the pixel set, whose surfaces stand at the given depths, at offsets (n,)."""
    fixed, config = stage_pixels(term), term.config
    found = _residuals(term, fixed, rows, seen.depth, offsets_px)
    usable = seen.on_surface & found.inside
    if term.hidden_right is not None:
        crop = term.cars.detection_row[fixed.object_index[rows]]
        usable = usable & ~term.hidden_right.at(crop, found.uv_right)
    left, weight = fixed.intensity_left[rows], fixed.neighbour_weight[rows]
    floor = config.contrast_floor_grey_levels
    return Match(patch_residual(found.residual, left, weight, config.patch, floor), usable)


def matching_costs(term: PhotometricTerm, rows: Tensor, seen: SeenSurface, offsets_px: Tensor) -> Tensor:
    """Costs (n, R) of rows (R,) of the pixel set: `PhotometricTerm.pixel_cost`, at offsets (n,) of the disparity."""
    fixed, config = stage_pixels(term), term.config
    weight = fixed.neighbour_weight[rows].mT.contiguous()
    lost = robust.huber_cost(config.lost_grey_levels, config.huber_grey_levels)
    # A few offsets at a time where the pixels are many, so that memory stays that of the other evaluations.
    at_once = max(1, _RESIDUALS_AT_ONCE // max(1, weight.numel()))
    parts = []
    for some in torch.split(offsets_px.to(seen.depth), at_once):
        found = match(term, rows, seen, some)
        cost = (_norm(found.residual.mT, config) * weight).sum(dim=1)
        parts.append(torch.where(found.usable, cost, lost * weight.sum(dim=0)))
    return torch.cat(parts) * fixed.gradient_weight[rows]


def agreement(term: PhotometricTerm, projected: ProjectedState) -> tuple[Tensor, Tensor]:
    """Mean absolute residual (B,) in grey levels of the usable pixels, and their share (B,) of the pixel set."""
    fixed = stage_pixels(term)
    usable, residual = term.values(projected)
    weight = fixed.neighbour_weight * usable[:, None]
    per_pixel = [(weight * residual.abs()).sum(dim=1), weight.sum(dim=1), usable.to(weight.dtype)]
    error, total, compared = fixed.segments.sum(torch.stack(per_pixel, dim=1)).unbind(dim=1)
    nothing = torch.full_like(total, torch.nan)
    count = fixed.segments.counts
    share = torch.where(count > 0, compared / count.clamp_min(1), nothing)
    return torch.where(total > 0, error / total.clamp_min(1), nothing), share


def _residuals(
    term: PhotometricTerm, fixed: PixelSet, rows: Tensor, depth: Tensor, offsets_px: Tensor
) -> DisparityResiduals:
    images, frame = fixed.images, term.cars.frame_index[fixed.object_index[rows]]
    right = (images.right, images.sizes, images.scale, frame)
    lines, left = fixed.lines.select(rows), fixed.intensity_left[rows]
    return residuals_on_lines(lines, depth, *right, left, _CENTRE, offsets_px)


def _norm(residual: Tensor, config: PhotometricConfig) -> Tensor:
    """`rho` of the term's robust norm in one pass over the residuals, for its weights are not asked for."""
    if config.truncated:
        residual = residual.clamp(-config.lost_grey_levels, config.lost_grey_levels)
    nothing = residual.new_zeros(()).expand_as(residual)
    return torch.nn.functional.huber_loss(residual, nothing, reduction="none", delta=config.huber_grey_levels)
