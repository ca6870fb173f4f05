"""The rows that the iterations evaluate by following their rays, as subjects: each ray and neighbour by itself."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.energy.tracked_energy import TrackedEnergy
from directshape_torch.laboratory import kinks
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.differences import Probe
from directshape_torch.laboratory.subjects import Experiment, Subject, forward_mode_columns
from directshape_torch.laboratory.term_experiment import term_experiment
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.tracking.field import BlockField, block_field
from directshape_torch.tracking.photometric import photometric_residuals
from directshape_torch.tracking.rays import BlockRays
from directshape_torch.tracking.silhouette import SilhouetteRows, linearise_silhouettes


def tracked_silhouettes(bench: Bench) -> Experiment:
    """Residuals of the rays of both images near their contours, at the depths that tracking gives them at the state."""
    terms = [bench.terms[name] for name in ("silhouette_left", "silhouette_right")]
    tracked = TrackedEnergy.of_terms(terms, bench.projected, None).silhouettes
    prior, T_obj_cam = bench.problem.prior, bench.state.T_obj_cam
    assert tracked is not None
    assert isinstance(prior, PCAShapePrior)
    rows, field = tracked.rows, block_field(bench.projected.shape)
    depth, crosses = tracked.fixed_depths(field, T_obj_cam)

    def residuals(delta: Tensor) -> Tensor:
        moved = bench.moved(delta)
        at = block_field(prior.bind(moved.code))
        return tracked.residuals(at, moved.T_obj_cam, (depth, crosses))[rows.filled]

    def evaluate(delta: Tensor) -> list[Probe]:
        moved = bench.moved(delta)
        points = rows.rays.in_objects(rows.rays.of_blocks(moved.T_obj_cam)).at(depth)
        sdf = block_field(prior.bind(moved.code)).value(points, rows.rays.owner)
        saturated = (rows.zeta * sdf).abs() >= rows.saturation
        cell = kinks.trilinear_cell(prior, points.movedim(0, -1))
        ids = {kinks.SATURATION: saturated[rows.filled].long(), kinks.TRILINEAR: cell[rows.filled]}
        return [Probe(residuals(delta), ids)]

    units = torch.ones(bench.num_unknowns, dtype=bench.state.code.dtype)
    autograd = forward_mode_columns(lambda d: residuals(d[0])[None], torch.zeros_like(units)[None])[0]
    analytic = _silhouette_rows(field, rows, T_obj_cam, tracked.anchor_obj)
    subject = Subject("tracked_silhouettes", analytic, autograd, crosses[rows.filled])
    return Experiment((subject,), torch.no_grad()(evaluate), units)


def tracked_photometric(bench: Bench) -> Experiment:
    """Tracked rows at the surface of the state, against autograd and differences of the marched term."""
    of_term = term_experiment(bench, ["photometric"])
    tracked = TrackedEnergy.of_terms([bench.terms["photometric"]], bench.projected, None).photometric
    assert tracked is not None
    fixed = tracked.fixed_depths(block_field(bench.projected.shape), bench.state.T_obj_cam)
    residual = photometric_residuals(tracked.rows, tracked.settings, fixed.surface.depth)
    # All neighbours share the depth of their pixel.
    J = residual.J_residual_depth[..., None] * fixed.surface.J_depth_state[:, :, None]
    filled = tracked.rows.pixel_weight > 0
    usable = fixed.usable[filled].repeat_interleave(J.shape[2])
    (marched,) = of_term.subjects
    subject = replace(
        marched,
        name="tracked_photometric",
        analytic=torch.where(usable[:, None], J[filled].flatten(0, 1), torch.zeros_like(marched.analytic)),
        usable=marched.usable & usable,
    )
    return replace(of_term, subjects=(subject,))


def _silhouette_rows(field: BlockField, rows: SilhouetteRows, T_obj_cam: Tensor, anchor_obj: Tensor) -> Tensor:
    """Hand-derived Jacobian (R, D) of the R rays in filled places: each in a block of its own, whose sum it is."""
    block, place = rows.filled.nonzero().unbind(1)

    def alone(per_place: Tensor) -> Tensor:
        return per_place[..., block, place, None].expand(*per_place.shape[:-2], -1, rows.filled.shape[1])

    owner = rows.rays.owner[block]
    singles = rows._replace(
        rays=BlockRays(owner, rows.rays.centre_cam[block], alone(rows.rays.ray_cam)),
        zeta=rows.zeta[block],
        foreground=alone(rows.foreground),
        filled=torch.arange(rows.filled.shape[1], device=owner.device).expand(len(owner), -1) == 0,
    )
    sums = linearise_silhouettes(field, singles, T_obj_cam[owner, :3], alone(anchor_obj))
    return sums.products[:, -1]
