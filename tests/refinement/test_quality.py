"""The agreement with images is counted pixel by pixel, and evidence and costs of a car say what they are."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, begun_stage, figures_at, photometric_of
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.refinement.disparity_profile import disparity_profile
from directshape_torch.refinement.make_result import result_of, unrefined_result
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refinement.quality import FitQuality, fit_quality, mask_ious, photometric_agreement
from directshape_torch.refinement.trust import EVIDENCE_NAMES
from directshape_torch.scene.frames import FrameBatch
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


def halves_apart(frames: FrameBatch) -> Tensor:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, frames, scene.detections)
    at = stage.photometric_part(stage.figures(stage.problem.prepare(state)))
    assert at is not None
    return disparity_profile(stage.photometric, at.anchor, at.anchor, len(state.code), state.code).halves_apart


def test_halves_of_one_car_agree_and_those_of_two_places_do_not() -> None:
    scene = cached_street()[1]
    height = scene.frames.images_right.shape[-2]
    right = scene.frames.images_right.clone()
    # Below the middle of the cars everything has two pixels more of disparity.
    line = height // 2 + 8
    right[..., line:, :] = right[..., line:, :].roll(-2, dims=-1)
    whole, torn = (halves_apart(frames) for frames in (scene.frames, replace(scene.frames, images_right=right)))
    assert (whole < 0.3).all()
    assert (torn > whole + 0.5).any()


def quality(distance: Tensor, chances: tuple[Tensor, Tensor]) -> FitQuality:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    seen = stage.problem.prepare(state)
    return fit_quality(stage, stage.figures(seen), seen, torch.tensor([0.02, 0.48]).double(), distance, chances)


def test_columns_by_hand_and_a_car_that_is_not_there_is_not_better() -> None:
    ones = torch.ones(2).double()
    found = quality(torch.tensor([1.0, torch.nan]).double(), (ones, 0.5 * ones))
    assert found.evidence.shape == (2, len(EVIDENCE_NAMES))
    torch.testing.assert_close(found.evidence[:, 0].exp(), torch.tensor([0.04, 0.5]).double())
    torch.testing.assert_close(found.evidence[0, 2].exp(), torch.tensor(4.0).double())
    assert found.evidence[1, 2].isnan()
    torch.testing.assert_close(found.probability_not_worse, 0.5 * found.probability_better)
    near, far = (quality(distance * ones, (ones, ones)).probability_better for distance in (2.0, 8.0))
    assert (far < near - 0.05).all()
