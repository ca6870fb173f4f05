"""The regimes draw what their names say, and the same states every time."""

from __future__ import annotations

from collections.abc import Callable

import torch

from directshape_torch.laboratory.bench import Bench, near_border
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.shape.pca_prior import PCAShapePrior

BenchOf = Callable[..., Bench]


def test_views_of_a_track_are_seen_in_the_next(bench_of: BenchOf) -> None:
    assert len(bench_of("track", states=1).state.code) == 2
    at = bench_of("track", states=3)
    assert torch.equal(at.state.T_obj_next[:2, 0], at.state.T_obj_cam[1:])
    term = at.terms["next_view"]
    counts = [int((term.row_weight[term.blocks.owner == car] > 0).sum()) for car in range(3)]
    assert min(counts[:2]) > 0
    assert counts[2] == 0


def test_pixels_of_a_regime(bench_of: BenchOf, prior: PCAShapePrior) -> None:
    at = bench_of("contour")
    filled = at.problem.masks.filled > 0
    sdf = at.prepared.field.sdf(at.prepared.closest.points_obj, at.problem.masks.rays.owner)
    exponent = (at.terms["silhouettes"].zeta * sdf).abs()[filled]  # type: ignore[attr-defined]
    assert len(exponent) > 5
    assert (exponent < 3).all()

    at = bench_of("grazing")
    num_left = len(at.problem.masks.of_sides[0].owner)
    left = at.problem.masks.filled[:num_left] > 0
    direction = at.problem.masks.rays.in_objects(at.state.T_obj_cam).direction_obj[:, :num_left]
    cosine = torch.cosine_similarity(at.prepared.hits.normal_obj, direction, dim=0)[left]
    assert len(cosine) > 5
    assert (cosine.abs() < 0.31).all()

    at = bench_of("grid_border")
    near = near_border(prior, at.prepared.closest.points_obj)[at.problem.masks.filled > 0]
    assert len(near) > 5
    assert near.float().mean() > 0.9


def test_draws_repeat_and_do_not_depend_on_other_regimes(scene: LaboratoryScene, prior: PCAShapePrior) -> None:
    torch.manual_seed(5)
    first = Bench.build(scene, prior, REGIMES["far_80m"], 2, seed=3, pixels_per_car=4)
    torch.manual_seed(6)
    again = Bench.build(scene, prior, REGIMES["far_80m"], 2, seed=3, pixels_per_car=4)
    other = Bench.build(scene, prior, REGIMES["far_80m"], 2, seed=4, pixels_per_car=4)
    assert torch.equal(first.state.T_obj_cam, again.state.T_obj_cam)
    assert torch.equal(first.problem.masks.rays.ray_cam, again.problem.masks.rays.ray_cam)
    assert not torch.equal(first.state.T_obj_cam, other.state.T_obj_cam)
