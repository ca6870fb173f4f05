"""The depth of the surface under a pixel: first derivatives three ways, second derivatives two ways."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.laboratory import kinks
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.differences import Probe
from directshape_torch.laboratory.subjects import Experiment, Subject, forward_mode_columns
from directshape_torch.residuals.photometric import depth_state_jacobian, surface_slope
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.raycast import attached_depth

_MAX_PIXELS = 160


def ray_depth_experiment(bench: Bench) -> Experiment:
    """Depth of the first surface point of the left rays that hit without grazing, by the state of their car."""
    prior, min_cosine = bench.problem.prior, bench.problem.config.photometric.min_ray_cosine
    assert isinstance(prior, PCAShapePrior)
    chosen = surface_pixels(bench)
    rays, root = bench.projected.left.surface(chosen)
    points = rays.at(root.depth)
    at = bench.projected.shape.value_and_derivatives(points, rays.object_index)
    surface = depth_state_jacobian(points, at, rays.direction_obj, min_cosine)
    usable = torch.ones_like(root.found)

    def evaluate(delta: Tensor) -> list[Probe]:
        projected = bench.project(bench.moved(delta))
        moved_rays, moved = projected.left.surface(chosen)
        at_points = moved_rays.at(moved.depth)
        gradient = projected.shape.value_and_derivatives(at_points, rays.object_index).gradient
        grazing = surface_slope(gradient, moved_rays.direction_obj, min_cosine)[1]
        return [
            Probe(moved.depth, {kinks.GRAZING: grazing.long(), kinks.TRILINEAR: kinks.trilinear_cell(prior, at_points)})
        ]

    def attached(delta: Tensor) -> Tensor:
        projected = bench.problem.project(bench.moved(delta[0]), frozen=bench.projected, root_iterations=0)
        return attached_depth(projected.shape, projected.left.rays.select(chosen), root.depth, usable)[None]

    units = torch.ones(bench.num_unknowns, dtype=bench.state.code.dtype)
    autograd = forward_mode_columns(attached, torch.zeros_like(units)[None])[0]
    subject = Subject("ray_depth", surface.J_depth_state, autograd, usable)
    return Experiment((subject,), evaluate, units)


def surface_pixels(bench: Bench, most: int = _MAX_PIXELS) -> Tensor:
    """Rows (Q,) of left pixels whose rays hit without grazing, evenly chosen, at most so many."""
    every = torch.arange(len(bench.problem.left))
    rays, root = bench.projected.left.surface(every)
    at = bench.projected.shape.value_and_derivatives(rays.at(root.depth), rays.object_index)
    min_cosine = bench.problem.config.photometric.min_ray_cosine
    grazing = surface_slope(at.gradient, rays.direction_obj, min_cosine)[1]
    rows = (root.found & ~grazing).nonzero()[:, 0]
    return rows[torch.linspace(0, max(len(rows) - 1, 0), min(len(rows), most)).round().long()]
