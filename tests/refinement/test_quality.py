"""These tests check the agreement with the images pixel by pixel, and costs of cars that keep their input."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, begun_stage, figures_at, photometric_of
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.config import RefinerConfig
from directshape_torch.refinement.make_result import result_of, unrefined_result
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refinement.quality import mask_ious, photometric_agreement
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.status import Status


def begun(config: RefinerConfig = DEFAULT) -> tuple[CarStage, CarState]:
    scene = cached_street()[1]
    return begun_stage(ellipsoid_prior(), scene.frames, disturbed(scene.detections), config)


def test_mask_overlap_is_that_of_rays_through_the_shape() -> None:
    """Covered: some of 400 points on the ray is inside; counted car by car in a loop."""
    stage, state = begun()
    problem = stage.problem
    masks, seen = problem.masks, problem.prepare(state)
    found = mask_ious(masks, seen)
    assert found.shape == (2, 2)
    rays = masks.rays.in_objects(state.T_obj_cam)
    inside = rays.interval(problem.prior.bounds_obj)
    depths = inside.near + torch.linspace(0, 1, 400)[:, None, None] * (inside.far - inside.near)
    covered = (seen.field.sdf(rays.at(depths), masks.rays.owner) < 0).any(dim=0) & inside.hit
    for side in range(2):
        for car in range(2):
            mine = (masks.filled > 0) & ((masks.rays.owner == car) & (masks.side == side))[:, None]
            of_shape, of_mask = covered[mine], masks.foreground[mine] > 0.5
            expected = (of_shape & of_mask).sum() / (of_shape | of_mask).sum()
            assert 0.3 < float(expected) < 0.99
            # A ray that grazes the shape may touch it between two of the samples.
            assert abs(float(found[side, car] - expected)) < 0.01


def test_a_mask_of_nothing_on_a_shape_beside_all_pixels_has_no_overlap() -> None:
    scene = cached_street()[1]
    stage, state = begun_stage(ellipsoid_prior(), scene.frames, scene.detections)
    T = state.T_obj_cam.clone()
    T[0, 2, 3] += 500.0
    masks = stage.problem.masks
    empty = ((masks.rays.owner == 0) & (masks.side == 0))[:, None]
    masks = replace(masks, foreground=torch.where(empty, 0.0, masks.foreground))
    found = mask_ious(masks, stage.problem.prepare(CarState.of(T, state.code)))
    assert found[0, 0].isnan()
    assert found[1, 0] == 0
    assert (found[:, 1] > 0.8).all()


def test_photometric_agreement_is_the_mean_over_the_usable_pixels_car_by_car() -> None:
    stage, state = begun()
    term = photometric_of(stage)
    fixed = term.pixel_set
    T = state.T_obj_cam.clone()
    T[:, 0, 3] += 0.5  # where part of the pixel set has no surface any more
    for at in (state, CarState.of(T, state.code)):
        rows = stage.photometric_part(figures_at(stage, at))
        assert rows is not None
        error, share, contrast = photometric_agreement(term, rows)
        for car in range(2):
            in_set = (fixed.rows.pixel_weight > 0) & (fixed.blocks.owner == car)[:, None]
            usable = in_set & rows.anchor.usable
            weight = fixed.rows.neighbour_weight.movedim(0, -1)[usable]
            expected = (weight * rows.residual[usable].abs()).sum() / weight.sum()
            torch.testing.assert_close(error[car], expected, rtol=1e-9, atol=0)
            # The contrast is the deviation within neighbourhoods.
            grey = fixed.rows.intensity_left.movedim(0, -1)[usable]
            mean = (weight * grey).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
            expected = (weight * (grey - mean).abs()).sum() / weight.sum()
            torch.testing.assert_close(contrast[car], expected, rtol=1e-9, atol=0)
            torch.testing.assert_close(share[car], usable.sum() / in_set.sum().double(), rtol=1e-12, atol=0)


def test_a_car_with_its_input_back_costs_after_what_it_cost_before() -> None:
    stage, initial = begun()
    problem = stage.problem
    end = CarState.of(initial.T_obj_cam.clone(), initial.code + 0.5)
    prepared_initial, prepared_end = problem.prepare(initial), problem.prepare(end)
    minimum = Minimum(
        state=CarState(*(torch.stack([a[0], b[1]]) for a, b in zip(initial, end, strict=True))),
        end=end,
        status=torch.tensor([Status.rejected_worse.code, Status.converged.code]),
        iterations=torch.zeros(2, dtype=torch.long),
        cost_history=torch.zeros(2, 0).double(),
        stage_starts=(initial,),
        stage=stage,
        prepared_end=prepared_end,
        before=stage.figures(prepared_initial),
        after=stage.figures(prepared_end),
    )
    scene = cached_street()[1]
    frames, detections = scene.frames, disturbed(scene.detections)
    unrefined = unrefined_result(problem.prior, frames, detections, minimum.status, problem.term_names)
    found = result_of(problem, minimum, CarBatch.from_scene(frames, detections), unrefined)
    at_end, at_input = (figures_at(stage, state).term_costs for state in (end, initial))
    assert torch.equal(found.cost_before, at_input)
    assert torch.equal(found.cost_after, torch.stack([at_input[0], at_end[1]]))
    assert not torch.allclose(at_end[0], at_input[0])
