"""Where the functions of the chain have kinks: ids of the smooth piece that an argument lies in, one rule each.

The trilinear and the bilinear lookup are smooth inside a cell, the Huber norm on either side of its corner, a
projection as long as it is not saturated. A difference is trusted when both its ends have the ids of its centre.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.term import ResidualRows, Term
from directshape_torch.geometry.stereo import warp_to_right
from directshape_torch.residuals.photometric import DSO_PATTERN, surface_slope
from directshape_torch.residuals.silhouette import residual_derivative_product
from directshape_torch.shape.pca_prior import PCAShapePrior

TRILINEAR = "trilinear cell border"
BILINEAR = "bilinear cell border"
SATURATION = "saturation of the silhouette"
HIT = "hit or miss"
GRAZING = "grazing limit"
LOST = "right image border or occluder"
HUBER = "Huber corner"

# A sample whose share in a row is smaller cannot move the row by what the bounds allow, kink or not. Rows shorter than
# a millionth of the longest are judged by that millionth, their samples too.
_IRRELEVANT_SHARE = 1e-9
_FLAT_SHARE = 1e-6


def trilinear_cell(prior: PCAShapePrior, points_obj: Tensor) -> Tensor:
    """Cell numbers (..., 3) of points (..., 3) in a prior's grid; -1 and the last number stand for outside."""
    lower, upper = prior.bounds_obj
    last = ((upper - lower) / prior.spacing_m).round()
    cell = ((points_obj - lower) / prior.spacing_m).floor()
    return torch.minimum(cell.clamp_min(-1), last).long()


def bilinear_cell(uv: Tensor, size: Tensor) -> Tensor:
    """Cell numbers (..., 2) of pixels (..., 2) in images of sizes (..., 2) = (height, width); -1 stands for outside."""
    last = size.flip(-1) - 1
    inside = (uv >= 0) & (uv <= last)
    return torch.where(inside, torch.minimum(uv.floor(), (last - 1).to(uv)).long(), -1)


def term_branches(
    term: Term, prior: PCAShapePrior, projected: ProjectedState, rows: ResidualRows, relevant: Tensor | None
) -> Mapping[str, Tensor]:
    """Ids (R,) or (R, k) of a term's rows, by rule; the priors are smooth everywhere.

    Args:
        term: with a stage begun.
        prior: whose grid the shapes are on.
        projected: the state.
        rows: the term's residuals there.
        relevant: from `relevant_samples` at the centre.
    """
    if isinstance(term, SilhouetteTerm):
        return _silhouette_branches(term, prior, projected, relevant)
    if isinstance(term, PhotometricTerm):
        return _photometric_branches(term, prior, projected, rows)
    return {}


def relevant_samples(term: Term, projected: ProjectedState) -> Tensor | None:
    """Which samples (P, S) of the product form have a noticeable share in their ray's Jacobian; None elsewhere."""
    if not isinstance(term, SilhouetteTerm) or term.config.form != "product":
        return None
    view = projected.left if term.side == "left" else projected.right
    share = residual_derivative_product(view.march.sdf, term.zeta, term.foreground)[1].abs()
    if not len(share):
        return share > 0
    return share > _IRRELEVANT_SHARE * share.amax(dim=1, keepdim=True).clamp_min(float(_FLAT_SHARE * share.max()))


def _silhouette_branches(
    term: SilhouetteTerm, prior: PCAShapePrior, projected: ProjectedState, relevant: Tensor | None
) -> Mapping[str, Tensor]:
    view = projected.left if term.side == "left" else projected.right
    if relevant is not None:
        depths = view.march.depths
        points = view.rays.origin_obj[:, None] + depths[..., None] * view.rays.direction_obj[:, None]
        cells = torch.where(relevant[..., None], trilinear_cell(prior, points), 0)
        return {TRILINEAR: cells.flatten(1)}
    points = view.rays.at(view.closest_depth)
    sdf = projected.shape.value(points, view.rays.object_index)
    saturated = (term.zeta * sdf).abs() >= term.config.saturation
    return {SATURATION: saturated.long(), TRILINEAR: trilinear_cell(prior, points)}


def _photometric_branches(
    term: PhotometricTerm, prior: PCAShapePrior, projected: ProjectedState, rows: ResidualRows
) -> Mapping[str, Tensor]:
    fixed = term.fixed
    assert fixed is not None
    rays, root = projected.left.surface(fixed.pixel_index)
    points = rays.at(root.depth)
    gradient = projected.shape.value_and_derivatives(points, rays.object_index).gradient
    grazing = surface_slope(gradient, rays.direction_obj, term.config.min_ray_cosine)[1]
    neighbours = len(DSO_PATTERN)
    per_pixel = {HIT: root.found.long(), GRAZING: grazing.long(), TRILINEAR: trilinear_cell(prior, points)}
    ids = {rule: x.repeat_interleave(neighbours, dim=0) for rule, x in per_pixel.items()}
    size = fixed.images.sizes[term.cars.frame_index[fixed.object_index]][:, None]
    cells = bilinear_cell(photometric_pixels_right(term, root.depth), size)
    # Where the mean is taken off, each row depends on the cells of the whole neighbourhood.
    own = cells.flatten(0, 1)
    met = own if term.config.patch == "plain" else cells.flatten(1).repeat_interleave(neighbours, dim=0)
    return ids | {BILINEAR: met, LOST: rows.usable.long()}


def photometric_pixels_right(term: PhotometricTerm, depth: Tensor) -> Tensor:
    """Where the neighbourhoods (Q, N, 2) of a term's pixels land in the right image of its level, for depths (Q,)."""
    fixed, cars = term.fixed, term.cars
    assert fixed is not None
    car = fixed.object_index
    offsets = (x[fixed.pixel_index][:, None] for x in (term.pixels.bias_px, term.pixels.vertical_px))
    warped = warp_to_right(
        fixed.rays_left, depth[:, None], cars.K_right[car][:, None], cars.T_right_cam[car][:, None], *offsets
    )
    return (warped.uv_right + 0.5) * fixed.images.scale - 0.5
