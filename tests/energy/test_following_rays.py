"""From iteration to iteration: what is followed, what is left behind, and that no car touches another."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved
from helpers.five_cars import begun_stage, five_cars, step_of, with_solver
from helpers.host_traffic import host_traffic
from helpers.problems import DEFAULT, MARCHED, begun_problem
from helpers.synthetic_scene import cached_street, disturbed, select
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.tracked_energy import TrackedEnergy
from directshape_torch.geometry import se3
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult
from directshape_torch.solver.problem import Linearisation, StageProblem
from directshape_torch.tracking.field import block_field
from directshape_torch.tracking.photometric import surface_under

ALL = torch.ones(5, dtype=torch.bool)


@pytest.fixture(autouse=True)
def no_graph() -> object:
    """As in the iterations, which differentiate nothing."""
    with torch.no_grad():
        yield


def assert_same(found: Linearisation, expected: Linearisation) -> None:
    """Of batches of another size, whose products of small matrices may be added in another order."""
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-11, atol=1e-11 * float(y.abs().max()) if y.numel() else 0.0)


def assert_same_bits(found: Linearisation, expected: Linearisation) -> None:
    for x, y in zip(found, expected, strict=True):
        assert torch.equal(x, y)


def rows(at: Linearisation, cars: list[int] | Tensor) -> Linearisation:
    return Linearisation(*(x[cars] for x in at))


# Following.


def energy_of(problem: CarProblem, state: CarState) -> TrackedEnergy:
    return TrackedEnergy.of_terms(problem.terms, problem.project(state), None)


def closest_distances(energy: TrackedEnergy, problem: CarProblem, state: CarState) -> tuple[Tensor, Tensor]:
    """Least signed distance of the rays in play, left and right, as they are tracked and as they are marched."""
    assert energy.silhouettes is not None
    silhouettes, field = energy.silhouettes, block_field(problem.prior.bind(state.code))
    depth, crosses = silhouettes.fixed_depths(field, state.T_obj_cam)
    rays = silhouettes.rows.rays
    tracked = field.value(rays.in_objects(rays.of_blocks(state.T_obj_cam)).at(depth), rays.owner)
    projected, marched, crossed = problem.project(state), [], []
    for term in problem.terms:
        if isinstance(term, SilhouetteTerm):
            view = term.view(projected)
            marched.append(view.closest_sdf)
            crossed.append(view.march.crosses_bounds)
    filled = silhouettes.rows.filled
    both = crosses[filled] & torch.cat(crossed)
    assert torch.equal(crosses[filled], torch.cat(crossed))
    return tracked[filled][both], torch.cat(marched)[both]


def surface_depths(
    energy: TrackedEnergy, problem: CarProblem, state: CarState
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth and whether there is a surface, of the pixel set, as they are tracked and as they are marched."""
    assert energy.photometric is not None
    photometric, (term,) = energy.photometric, (t for t in problem.terms if isinstance(t, PhotometricTerm))
    rays = photometric.rows.rays
    field, T = block_field(problem.prior.bind(state.code)), rays.of_blocks(state.T_obj_cam)
    surface = surface_under(field, photometric.rows, photometric.settings, T, photometric.hits)
    filled = photometric.rows.pixel_weight > 0
    rows, root = problem.project(state).left.surface(term.pixel_set.pixel_index)
    at = problem.prior.bind(state.code).value_and_derivatives(rows.at(root.depth), rows.object_index)
    slope = (at.gradient * rows.direction_obj).sum(-1)
    steep = slope.abs() > 0.1 * at.gradient.norm(dim=-1) * rows.direction_obj.norm(dim=-1)
    return surface.depth[filled], surface.usable[filled], root.depth, root.found & steep


# Standard deviation of each unknown of a step: metres and radians, and of the code; bound of the closest distances'
# 99th percentile and maximum (m); share of the surfaces that are found, and bound of their depths (m), 99 % and all.
STEPS = {
    "small": (0.003, 0.02, 5e-3, 0.06, 0.99, 1e-6, 5e-3),
    "middling": (0.02, 0.1, 2e-2, 0.25, 0.98, 1e-3, 1e-2),
    "large": (0.1, 0.5, 0.1, 0.35, 0.8, 2e-2, 0.1),
}


@pytest.mark.parametrize("size", STEPS)
def test_after_a_step_closest_points_and_surfaces_are_the_marched_ones_or_lost(size: str) -> None:
    """All rays in play at the first stage. What a large step loses is lost; what it keeps is right all the same."""
    motion, code, percentile_m, most_m, share, depth_percentile_m, depth_most_m = STEPS[size]
    problem, _, state = begun_stage(stage=0)
    energy = energy_of(problem, state)
    there = moved(state, step_of(5, motion, code))
    tracked, marched = closest_distances(energy, problem, there)
    off = (tracked - marched).abs()
    assert float(off.quantile(0.99)) < percentile_m
    assert float(off.max()) < most_m
    depth, usable, root, found = surface_depths(energy, problem, there)
    both = usable & found
    assert float(both.sum()) > share * float(found.sum())
    error = (depth - root)[both].abs()
    assert float(error.quantile(0.99)) < depth_percentile_m
    assert float(error.max()) < depth_most_m
    # Hardly any surface where marching sees none: beside the car, or turned away.
    assert float((usable & ~found).sum()) < 0.02 * len(found)
    if size == "large":
        assert not usable.all()


def test_a_state_that_is_followed_to_is_evaluated_from_its_own_hits() -> None:
    """The second evaluation there begins on the surface itself: the pixels that were found have the marched depth."""
    problem, _, state = begun_stage(stage=0)
    energy = energy_of(problem, state)
    there = moved(state, step_of(5, 0.02, 0.1))
    shape = problem.prior.bind(there.code)
    _, first, _, _ = surface_depths(energy, problem, there)
    energy.linearise(shape, there)
    energy.follow(ALL)
    depth, usable, root, found = surface_depths(energy, problem, there)
    assert (usable | ~first).all()
    error = (depth - root)[usable & found & first].abs()
    # A grid has kinks: Newton's step of the first evaluation may have ended in the next cell.
    assert float(error.quantile(0.98)) < 1e-6
    assert float(error.max()) < 0.02


def test_a_walk_of_small_steps_stays_with_the_marched_energy() -> None:
    """Twenty steps to and fro, 0.05 m in all: nothing drifts, and what is lost on the way is lost at the rim."""
    problem, _, state = begun_stage(stage=0)
    energy = energy_of(problem, state)
    heading = step_of(5, 0.01, 0.05, seed=11)
    for i in range(20):
        state = moved(state, heading if i % 10 < 5 else -heading)
        tracked, marched = closest_distances(energy, problem, state)
        assert float((tracked - marched).abs().quantile(0.99)) < 0.02
        depth, usable, root, found = surface_depths(energy, problem, state)
        assert float((usable != found).double().mean()) < 0.03
        assert float((depth - root)[usable & found].abs().quantile(0.98)) < 1e-3
        energy.linearise(problem.prior.bind(state.code), state)
        energy.follow(ALL)


def test_a_refused_step_leaves_no_trace() -> None:
    _, stage, state = begun_stage()
    _, other, _ = begun_stage()
    before = stage.linearise(state)
    stage.follow(ALL)
    other.linearise(state)
    other.follow(ALL)
    stage.linearise(moved(state, step_of(5, 0.1, 0.5)))
    stage.follow(~ALL)
    near = moved(state, step_of(5, 0.005, 0.02, seed=8))
    assert_same_bits(stage.linearise(near), other.linearise(near))
    assert not torch.equal(before.cost, stage.linearise(near).cost)


def test_each_car_follows_for_itself() -> None:
    """Cars that accept a step go on as if all had, the others as if none had."""
    accepted = torch.tensor([True, False, False, True, False])
    trial, last = step_of(5, 0.02, 0.1), step_of(5, 0.01, 0.05, seed=9)
    found = []
    for follows in (ALL, ~ALL, accepted):
        _, stage, state = begun_stage()
        stage.linearise(moved(state, trial))
        stage.follow(follows)
        found.append(stage.linearise(moved(state, last)))
    every, none, some = found
    assert_same_bits(rows(some, accepted), rows(every, accepted))
    assert_same_bits(rows(some, ~accepted), rows(none, ~accepted))
    assert (every.cost != none.cost).all()


def test_following_before_anything_was_evaluated_changes_nothing() -> None:
    _, stage, state = begun_stage()
    _, other, _ = begun_stage()
    stage.follow(ALL)
    assert_same_bits(stage.linearise(state), other.linearise(state))


# Cars in a batch.


def walked(stage: StageProblem[CarState], state: CarState, steps: list[Tensor]) -> list[Linearisation]:
    """Linearisations along steps that are all accepted."""
    found = []
    for step in steps:
        state = moved(state, step)
        found.append(stage.linearise(state))
        stage.follow(torch.ones(len(state.code), dtype=torch.bool))
    return found


WALK = [step_of(5, 0.01, 0.05, seed=s) for s in (1, 2, 3)]


@pytest.mark.parametrize("cars", [[0], [2], [4], [1, 3], [4, 0, 2]])
def test_a_car_alone_is_what_it_is_among_others(cars: list[int]) -> None:
    """Where none hides another: who is left out of the detections hides nobody."""
    config = replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=False))
    _, stage, state = begun_stage(config)
    _, part, part_state = begun_stage(config, cars=cars)
    together, alone = walked(stage, state, WALK), walked(part, part_state, [step[cars] for step in WALK])
    for whole, own in zip(together, alone, strict=True):
        assert_same(own, rows(whole, cars))


@pytest.mark.parametrize("broken", ["pose", "code"])
def test_a_broken_car_touches_no_other(broken: str) -> None:
    _, stage, state = begun_stage()
    _, other, _ = begun_stage()
    bad = CarState(state.T_obj_cam.clone(), state.code.clone())
    (bad.T_obj_cam if broken == "pose" else bad.code)[2] = torch.nan
    others = torch.tensor([0, 1, 3, 4])
    for step in WALK:
        clean, found = walked(other, state, [step]), walked(stage, bad, [step])
        assert_same_bits(rows(found[0], others), rows(clean[0], others))
        assert not found[0].gradient[2].isfinite().all()


@pytest.mark.parametrize("keep", [[0, 3], [1, 2, 4], [2], [], [0, 1, 2, 3, 4]])
def test_cars_that_leave_change_nothing_of_the_others(keep: list[int]) -> None:
    """In the middle of a stage, with what has been followed by then."""
    _, stage, state = begun_stage()
    walked(stage, state, WALK[:1])
    kept = torch.zeros(5, dtype=torch.bool)
    kept[keep] = True
    fewer = stage.compact(kept, keep)
    there = moved(state, WALK[0])
    part = CarState(*(x[kept] for x in there))
    whole, some = walked(stage, there, WALK[1:]), walked(fewer, part, [step[kept] for step in WALK[1:]])
    for all_cars, of_some in zip(whole, some, strict=True):
        assert_same(of_some, rows(all_cars, kept))
    if len(keep) > 1:
        again = torch.zeros(len(keep), dtype=torch.bool)
        again[-1] = True
        last = fewer.compact(again, [len(keep) - 1])
        end = moved(there, WALK[1] + WALK[2])
        alone = last.linearise(CarState(*(x[keep[-1:]] for x in end)))
        assert_same(alone, rows(fewer.linearise(CarState(*(x[kept] for x in end))), [len(keep) - 1]))


def test_no_cars() -> None:
    _, stage, state = begun_stage(cars=[])
    at = stage.linearise(state)
    stage.follow(torch.zeros(0, dtype=torch.bool))
    assert [x.shape for x in at] == [(0,), (0, 9), (0, 9, 9)]
    prior, frames, detections = five_cars()
    result = DirectShapeRefiner(prior, DEFAULT)(frames, select(detections, torch.zeros(0, dtype=torch.long)))
    assert result.T_cam_obj.shape == (0, 4, 4)


def test_a_car_without_any_pixel_has_its_priors_alone() -> None:
    """Its mask is empty and its box behind the image's border, so neither image shows anything of it."""
    prior, frames, detections = five_cars()
    boxes, T = detections.box_2d.clone(), detections.T_cam_obj.clone()
    gone = 1
    boxes[gone] = torch.tensor([0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    T[gone, 0, 3] = 200.0
    masks = {}
    for side in ("mask_left", "mask_right"):
        masks[side] = getattr(detections, side).clone()
        masks[side][gone] = 0
    has = detections.has_mask_left.clone()
    has[gone] = False
    absent = replace(detections, T_cam_obj=T, box_2d=boxes, has_mask_left=has, has_mask_right=has, **masks)
    problem, state = DirectShapeRefiner(prior, DEFAULT).problem(frames, absent)
    stage = problem.begin_stage(problem.stages()[1], state)
    energy = energy_of(problem, state)
    assert energy.silhouettes is not None
    assert energy.photometric is not None
    assert (energy.photometric.blocks.owner != gone).all()
    at = stage.linearise(state)
    assert energy.priors is not None
    cost, products = energy.priors.parts(state)
    seen = int((problem.left.object_index == gone).sum() + (problem.right.object_index == gone).sum())
    if seen == 0:
        torch.testing.assert_close(at.cost[gone], cost[gone])
        torch.testing.assert_close(at.gradient[gone], products[gone, -1])
        torch.testing.assert_close(at.hessian[gone], products[gone, :-1])
    assert seen == 0
    assert at.cost.isfinite().all()


# Whole refinements.


def refined(rays: str, jacobian: str = "analytic") -> RefinementResult:
    prior, scene = cached_street()
    config = with_solver(DEFAULT, rays=rays, jacobian=jacobian, cost_tolerance=1e-9, step_tolerance=1e-9)
    config = replace(config, stages=tuple(replace(s, max_iterations=25) for s in config.stages))
    return DirectShapeRefiner(prior, config)(scene.frames, disturbed(scene.detections))


def test_marched_rays_lead_to_the_same_place() -> None:
    """By the marched energy of one set of pixels; the toy's grid is coarse, and its optimum flat."""
    tracked, marched = refined("tracked"), refined("marched")
    assert all(status.is_refined for status in (*tracked.status, *marched.status))
    prior, scene = cached_street()
    problem, start = begun_problem(prior, scene.frames, disturbed(scene.detections), MARCHED)
    costs = [problem.cost(CarState(se3.inverse(r.T_cam_obj), r.code)) for r in (tracked, marched)]
    assert (costs[1] < 0.6 * problem.cost(start)).all()
    torch.testing.assert_close(costs[0], costs[1], rtol=0.05, atol=0)
    apart = tracked.T_cam_obj[:, :3, 3] - marched.T_cam_obj[:, :3, 3]
    assert float(apart.norm(dim=1).max()) < 0.01
    assert float((tracked.code - marched.code).abs().max()) < 0.05


def test_differentiated_refinements_march() -> None:
    """The root that is differentiated must be one of the energy that is differentiated."""
    prior, scene = cached_street()
    config = replace(DEFAULT, backward=replace(DEFAULT.backward, mode="implicit"))
    problem, state = DirectShapeRefiner(prior, config).problem(scene.frames, disturbed(scene.detections))
    assert problem.begin_stage(problem.stages()[1], state) is problem
    reference, _ = DirectShapeRefiner(prior, MARCHED).problem(scene.frames, disturbed(scene.detections))
    assert reference.begin_stage(reference.stages()[1], state) is reference
    assert_same_bits(problem.linearise(state), reference.linearise(state))


# The host.


def test_an_iteration_of_tracked_rays_neither_waits_for_the_device_nor_sends_it_numbers() -> None:
    _, stage, state = begun_stage()
    step = step_of(5, 0.01, 0.05)

    def iteration() -> None:
        trial = stage.retract(state, step)
        stage.linearise(trial)
        stage.follow(ALL)

    assert host_traffic(iteration).found == []


def test_leaving_cars_out_waits_for_nothing_that_the_host_does_not_know() -> None:
    """The numbers of the cars that go on have been read; how many blocks they have is known since the stage began."""
    _, stage, _ = begun_stage()
    keep = torch.tensor([True, False, True, True, False])
    found = host_traffic(lambda: stage.compact(keep, [0, 2, 3])).found
    # Masks over cars: rows of a few numbers each.
    assert set(found) <= {"aten.index", "aten.lift_fresh"}, found


needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


@needs_gpu
def test_an_iteration_of_tracked_rays_on_a_gpu_never_waits() -> None:
    prior, frames, detections = five_cars()
    moved_prior = prior.to("cuda")
    try:
        problem, state = DirectShapeRefiner(moved_prior, DEFAULT).problem(frames.to("cuda"), detections.to("cuda"))
        stage = problem.begin_stage(problem.stages()[1], state)
        everything, step = ALL.to("cuda"), step_of(5, 0.01, 0.05).to("cuda")
        expected = stage.linearise(stage.retract(state, step))
        before = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            found = stage.linearise(stage.retract(state, step))
            stage.follow(everything)
        finally:
            torch.cuda.set_sync_debug_mode(before)
        assert_same_bits(found, expected)
    finally:
        prior.to("cpu")
    _, on_cpu, cpu_state = begun_stage()
    reference = on_cpu.linearise(moved(cpu_state, step_of(5, 0.01, 0.05)))
    for x, y in zip(found, reference, strict=True):
        torch.testing.assert_close(x.cpu(), y, rtol=1e-6, atol=1e-6 * float(y.abs().max()))
