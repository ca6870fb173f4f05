"""The tracked energy against the marched one at the same state, against single rays, and against autograd."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from helpers.derivatives import moved, relative_error
from helpers.ellipsoids import ellipsoid_prior
from helpers.five_cars import begun_stage, five_cars, step_of, with_solver
from helpers.problems import DEFAULT, NORMALISED, PAPER, TRUNCATED, begun_problem
from helpers.synthetic_scene import select
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.prior_terms import PriorTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.term import Term, total_of
from directshape_torch.energy.tracked_energy import TrackedEnergy, are_tracked
from directshape_torch.geometry import se3
from directshape_torch.solver.problem import Linearisation
from directshape_torch.tracking.field import block_field
from directshape_torch.tracking.photometric import photometric_residuals

CONFIGS = {"default": DEFAULT, "truncated": TRUNCATED, "normalised": replace(NORMALISED, stages=DEFAULT.stages)}


@pytest.fixture(autouse=True)
def no_graph() -> object:
    """As in the iterations, which differentiate nothing."""
    with torch.no_grad():
        yield


def kind_of(problem: CarProblem, kind: type[Term]) -> list[Term]:
    return [term for term in problem.terms if isinstance(term, kind)]


def tracked(
    problem: CarProblem,
    state: CarState,
    terms: list[Term],
    factors: Tensor | None = None,
    after_wider: bool = False,
) -> TrackedEnergy:
    """These terms alone, tracked from a state on."""
    return TrackedEnergy.of_terms(terms, problem.project(state), factors, after_wider)


def evaluated(energy: TrackedEnergy, problem: CarProblem, state: CarState) -> Linearisation:
    (part,) = energy.linearise(problem.prior.bind(state.code), state)
    return part


def marched(problem: CarProblem, state: CarState, terms: list[Term]) -> Linearisation:
    projected = problem.project(state)
    return total_of([term.linearise(projected) for term in terms])


def errors(found: Linearisation, expected: Linearisation) -> tuple[float, float, float]:
    """Of cost, gradient and matrix: the largest of the cars, each relative to the largest entry of the car."""
    worst = [[relative_error(x[b], y[b]) for b in range(len(y))] for x, y in zip(found[:3], expected, strict=True)]
    cost, gradient, hessian = (max(each) for each in worst)
    return cost, gradient, hessian


@pytest.mark.parametrize("stage", [0, 1])
@pytest.mark.parametrize("name", CONFIGS)
def test_where_a_stage_begins_the_photometric_rows_are_the_marched_ones(name: str, stage: int) -> None:
    """Both stand on the same roots there: two frames, two pyramid levels, pixels that nearer cars hide."""
    problem, _, state = begun_stage(CONFIGS[name], stage)
    terms = kind_of(problem, PhotometricTerm)
    found = evaluated(tracked(problem, state, terms), problem, state)
    assert max(errors(found, marched(problem, state, terms))) < 1e-9


UNOCCLUDED = replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=False))


@pytest.mark.parametrize("stage", [0, 1])
@pytest.mark.parametrize("name", [*CONFIGS, "no occlusion"])
def test_at_any_depth_a_pixel_lands_where_the_marched_one_does(name: str, stage: int) -> None:
    """Far beyond the images' borders and onto nearer cars: residuals, their derivative and what can be compared."""
    problem, state = cropped(CONFIGS.get(name, UNOCCLUDED), stage)
    (term,) = kind_of(problem, PhotometricTerm)
    assert isinstance(term, PhotometricTerm)
    energy = tracked(problem, state, [term]).photometric
    assert energy is not None
    assert energy.linearise(block_field(problem.prior.bind(state.code)), state.T_obj_cam).cost.isfinite().all()
    filled = energy.rows.pixel_weight > 0
    generator = torch.Generator().manual_seed(17)
    lost = []
    for scale in (1.0, 0.8, 0.35, 0.1, 3.0, 100.0):
        shares = 1 + 0.2 * torch.rand(len(term.pixel_set.object_index), generator=generator, dtype=torch.float64)
        depth = scale * shares * state_depth(problem, term, state)
        packed = torch.ones(filled.shape, dtype=torch.float64).masked_scatter(filled, depth)
        found, expected = photometric_residuals(energy.rows, energy.settings, packed), term._residual(depth)
        usable = term._is_usable(torch.ones_like(depth, dtype=torch.bool), expected.inside, expected.uv_right)
        assert torch.equal(found.comparable[filled], usable)
        lost.append(float((~usable).double().mean()))
        torch.testing.assert_close(found.value[filled][usable], expected.residual[usable], rtol=1e-9, atol=1e-9)
        slope = found.J_residual_depth[filled][usable]
        torch.testing.assert_close(slope, expected.J_residual_depth[usable], rtol=1e-8, atol=1e-8)
    assert all(0.05 < share < 0.95 for share in lost[2:3] + lost[-1:]), lost


def cropped(config: RefinerConfig, stage: int) -> tuple[CarProblem, CarState]:
    """Frames that end amid the cars, on the right and below, and a right camera 0.2 m off in height: with its depth a
    pixel leaves at every side. The far cars come first, and their right masks cover the nearest one's as well."""
    prior, frames, detections = five_cars()
    detections = select(detections, torch.tensor([2, 1, 0, 4, 3]))
    overlapping = detections.mask_right.maximum(detections.mask_right[[2, 2, 2, 4, 4]])
    detections = replace(detections, mask_right=overlapping)
    T_right_cam = frames.camera.T_right_cam.clone()
    T_right_cam[:, 1, 3] = 0.2
    camera = replace(frames.camera, T_right_cam=T_right_cam)
    frames = replace(frames, camera=camera, sizes=torch.tensor([[46, 64], [44, 60]]))
    return begun_problem(prior, frames, detections, config, stage)


def state_depth(problem: CarProblem, term: PhotometricTerm, state: CarState) -> Tensor:
    """Depth (Q,) of the surface under the pixels of the set."""
    return problem.project(state).left.surface(term.pixel_set.pixel_index)[1].depth


@pytest.mark.parametrize("stage", [0, 1])
def test_a_pixel_that_comes_to_be_hidden_or_leaves_the_image_pays_as_the_marched_one(stage: int) -> None:
    """Cars 2, 3 and 5 are pushed behind and beyond; rows follow them there without losing a surface on the way."""
    problem, _, state = begun_stage(DEFAULT, stage)
    terms = kind_of(problem, PhotometricTerm)
    energy = tracked(problem, state, terms)
    lost = []
    for _ in range(30):
        # In the camera's frame: to the left, where a nearer car or the border of the right image is.
        push = torch.zeros(5, 6, dtype=torch.float64)
        push[:, 0] = torch.tensor([0.01, 0.03, 0.02, 0.01, 0.05], dtype=torch.float64)
        state = CarState(state.T_obj_cam @ se3.exp(push), state.code)
        found = evaluated(energy, problem, state)
        energy.follow(torch.ones(5, dtype=torch.bool))
        (term,) = terms
        assert isinstance(term, PhotometricTerm)
        lost.append(float((~term.residuals(problem.project(state)).usable).double().mean()))
    assert lost[0] < 0.1
    assert 0.15 < lost[-1] < 0.9
    found = evaluated(energy, problem, state)
    reference = marched(problem, state, terms)
    # A ray that has lost its surface in between (grazing, past the car) may have it again when marched anew.
    torch.testing.assert_close(found.cost, reference.cost, rtol=0.06, atol=0)


@pytest.mark.parametrize(
    ("motion", "code", "bounds"), [(0.002, 0.01, (1e-6, 2e-3, 4e-3)), (0.01, 0.05, (2e-3, 4e-2, 4e-2))]
)
def test_photometric_rows_a_step_away(motion: float, code: float, bounds: tuple[float, float, float]) -> None:
    """From hits of the state before, as each trial state is evaluated; what is lost is lost at the car's rim."""
    problem, _, state = begun_stage()
    terms = kind_of(problem, PhotometricTerm)
    energy = tracked(problem, state, terms)
    there = moved(state, step_of(5, motion, code))
    found = errors(evaluated(energy, problem, there), marched(problem, there, terms))
    assert all(error < bound for error, bound in zip(found, bounds, strict=True)), found


SPACINGS = {0.2: (5e-3, 0.12, 0.02), 0.05: (2e-4, 0.07, 6e-3)}


@pytest.mark.parametrize("stage", [0, 1])
@pytest.mark.parametrize("spacing_m", SPACINGS)
def test_silhouettes_where_a_stage_begins_are_the_marched_ones_to_the_resolution_of_the_grid(
    spacing_m: float, stage: int
) -> None:
    """Both take a parabola's vertex for the closest approach, of samples at other places, and the field has kinks."""
    problem, state = on_grid(spacing_m, 32, stage)
    terms = kind_of(problem, SilhouetteTerm)
    found = errors(evaluated(tracked(problem, state, terms), problem, state), marched(problem, state, terms))
    assert all(error < bound for error, bound in zip(found, SPACINGS[spacing_m], strict=True)), found


@pytest.mark.parametrize("stage", [0, 1])
def test_tracked_silhouettes_are_as_near_to_dense_samples_as_marched_ones(stage: int) -> None:
    """Of 500 samples a ray, where the configuration has 24: in value and matrix; a gradient is a small difference."""
    dense, state = on_grid(0.05, 500, stage)
    truth = marched(dense, state, kind_of(dense, SilhouetteTerm))
    problem, _ = on_grid(0.05, 24, stage)
    terms = kind_of(problem, SilhouetteTerm)
    of_marched = errors(marched(problem, state, terms), truth)
    of_tracked = errors(evaluated(tracked(problem, state, terms), problem, state), truth)
    assert of_tracked[0] < 1.2 * of_marched[0]
    assert of_tracked[1] < 0.1
    assert of_tracked[2] < 1.2 * of_marched[2]


def on_grid(spacing_m: float, samples: int, stage: int) -> tuple[CarProblem, CarState]:
    """The five cars with shapes on another grid, a stage begun."""
    _, frames, detections = five_cars()
    config = replace(DEFAULT, silhouette=replace(DEFAULT.silhouette, samples_per_ray=samples))
    return begun_problem(ellipsoid_prior(spacing_m=spacing_m), frames, detections, config, stage)


NARROW = replace(DEFAULT, stages=tuple(replace(stage, contour_width_px=0.1) for stage in DEFAULT.stages))


@pytest.mark.parametrize(
    ("config", "stage", "after_wider"),
    [(DEFAULT, 0, False), (DEFAULT, 1, False), (NARROW, 1, False), (NARROW, 1, True)],
)
def test_sums_of_the_silhouettes_ray_by_ray(config: RefinerConfig, stage: int, after_wider: bool) -> None:
    """At the very depths that are tracked: c = lambda / number of pixels, and constants of the rays out of play."""
    problem, _, start = begun_stage(config, stage=stage)
    terms = kind_of(problem, SilhouetteTerm)
    energy = tracked(problem, start, terms, after_wider=after_wider)
    state = moved(start, step_of(5, 0.01, 0.1))
    found = evaluated(energy, problem, state)
    assert energy.silhouettes is not None
    depth, crosses = energy.silhouettes.fixed_depths(block_field(problem.prior.bind(state.code)), state.T_obj_cam)
    filled = energy.silhouettes.rows.filled
    depths, crossings = depth[filled], crosses[filled]  # left rays in play, right rays in play, in order
    cost, gradient, hessian = torch.zeros(5).double(), torch.zeros(5, 9).double(), torch.zeros(5, 9, 9).double()
    at_rest = 0
    for term in terms:
        assert isinstance(term, SilhouetteTerm)
        view = term.view(problem.project(start))
        sharpness = term.zeta * view.closest_sdf.abs()
        assert bool((0.2 * term.zeta > 10).any()) == (config is NARROW)
        margin = (0.2 * term.zeta).clamp_max(10 if after_wider else 1e9)
        in_play = (sharpness < 8 + margin) | ~view.march.crosses_bounds
        count = int(in_play.sum())
        assert torch.equal(crossings[:count], term.view(problem.project(state)).march.crosses_bounds[in_play])
        residual, J = residuals_by_definition(problem, term, state, in_play, depths[:count], crossings[:count])
        depths, crossings = depths[count:], crossings[count:]
        index = term.pixels.object_index
        for b in range(5):
            c = term.config.weight / int((index == b).sum())
            own = index[in_play] == b
            r, rows = residual[own], J[own]
            floored = r.clamp_min(term.config.residual_floor)
            cost[b] += c * (r.sum() + term.residual_at(view)[~in_play & (index == b)].sum())
            gradient[b] += c * rows.sum(dim=0)
            hessian[b] += c * (rows / floored[:, None]).mT @ rows
        at_rest += int((~in_play).sum())
    assert len(depths) == 0
    assert at_rest > (20 if stage == 1 else -1)
    torch.testing.assert_close(found.cost, cost, rtol=1e-10, atol=0)
    torch.testing.assert_close(found.gradient, gradient, rtol=1e-8, atol=1e-9 * float(gradient.abs().max()))
    torch.testing.assert_close(found.hessian, hessian, rtol=1e-8, atol=1e-9 * float(hessian.abs().max()))


def test_rays_leave_earlier_only_after_a_stage_with_a_wider_contour() -> None:
    """A single narrow stage has all the way to go, and follows its rays further."""

    def rows(*widths_px: float) -> int:
        stages = tuple(replace(DEFAULT.stages[1], contour_width_px=width) for width in widths_px)
        _, stage, _ = begun_stage(replace(DEFAULT, stages=stages), stage=len(stages) - 1)
        assert stage.energy.silhouettes is not None
        return int(stage.energy.silhouettes.rows.filled.sum())

    assert rows(1.0, 0.1) < 0.9 * rows(0.1)
    assert rows(0.1, 0.1) == rows(0.1)


def residuals_by_definition(
    problem: CarProblem, term: SilhouetteTerm, state: CarState, chosen: Tensor, depth: Tensor, crosses: Tensor
) -> tuple[Tensor, Tensor]:
    """Residuals of some rays at given depths, and their Jacobian by autograd."""
    pixels = term.pixels.select(chosen.nonzero()[:, 0])
    points_cam = pixels.origin_cam + depth[:, None] * pixels.ray_cam
    p, zeta, limit = term.foreground[chosen], term.zeta[chosen], term.config.saturation

    def residuals(delta: Tensor) -> Tensor:
        there = moved(state, delta.expand(5, 9))
        points = se3.transform(there.T_obj_cam[pixels.object_index], points_cam)
        x = zeta * problem.prior.bind(there.code).value(points, pixels.object_index)
        hit = torch.where(crosses, torch.sigmoid(-x.clamp(-limit, limit)), torch.zeros_like(x))
        return -torch.log(hit * p + (1 - hit) * (1 - p))

    zero = torch.zeros(9, dtype=torch.float64)
    return residuals(zero), torch.func.jacfwd(residuals)(zero)


def test_a_ray_that_crosses_the_bounds_begins_where_its_march_was_closest() -> None:
    problem, _, state = begun_stage()
    terms = kind_of(problem, SilhouetteTerm)
    energy = tracked(problem, state, terms).silhouettes
    assert energy is not None
    points, crosses = [], []
    for term in terms:
        assert isinstance(term, SilhouetteTerm)
        view = term.view(problem.project(state))
        in_play = (term.zeta * view.closest_sdf.abs() < 8 + 0.2 * term.zeta) | ~view.march.crosses_bounds
        points.append(view.rays.at(view.closest_depth)[in_play])
        crosses.append(view.march.crosses_bounds[in_play])
    begin, crossing = energy.anchor_obj.movedim(0, -1)[energy.rows.filled], torch.cat(crosses)
    assert int(crossing.sum()) > 1000
    torch.testing.assert_close(begin[crossing], torch.cat(points)[crossing], rtol=0, atol=1e-12)


def test_a_ray_that_misses_the_bounds_waits_by_their_middle() -> None:
    """Should it come in, it will come by there: the point of the ray that is next to it, whatever its march says."""
    problem, _, state = begun_stage()
    shifted = moved(state, torch.tensor([0.0, 1.2, 0.6] + [0.0] * 6, dtype=torch.float64).expand(5, 9))
    problem.begin_stage(problem.stages()[1], shifted)
    energy = tracked(problem, shifted, kind_of(problem, SilhouetteTerm)).silhouettes
    assert energy is not None
    rays = energy.rows.rays.in_objects(energy.rows.rays.of_blocks(shifted.T_obj_cam))
    bounds = problem.prior.bounds_obj
    misses = energy.rows.filled & ~rays.interval(bounds).hit
    assert int(misses.sum()) > 20
    middle = bounds.mean(dim=0).view(3, 1, 1)
    depth = rays.depth_next_to(energy.anchor_obj)
    torch.testing.assert_close(energy.anchor_obj[:, misses], rays.at(depth)[:, misses])
    aside = ((energy.anchor_obj - middle) * rays.direction_obj).sum(0)
    assert float(aside[misses].abs().max()) < 1e-9
    crossing = energy.rows.filled & ~misses
    assert float(aside[crossing].abs().max()) > 0.1


def test_factors_of_single_cars() -> None:
    problem, _, state = begun_stage()
    factors = torch.rand(5, len(problem.terms), generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.2
    weighted = tracked(problem, state, list(problem.terms), factors)
    there = moved(state, step_of(5, 0.005, 0.02))
    found = total_of(weighted.linearise(problem.prior.bind(there.code), there))
    expected = []
    for kind in (PhotometricTerm, PriorTerm, SilhouetteTerm):
        for term, factor in zip(problem.terms, factors.unbind(dim=1), strict=True):
            if isinstance(term, kind):
                one = evaluated(tracked(problem, state, [term]), problem, there)
                expected.append(Linearisation(*(factor.view(-1, *(1,) * (x.ndim - 1)) * x for x in one[:3])))
    cost, gradient, hessian = (torch.stack(x).sum(dim=0) for x in zip(*expected, strict=True))
    torch.testing.assert_close(found.cost, cost, rtol=1e-10, atol=0)
    torch.testing.assert_close(found.gradient, gradient, rtol=1e-9, atol=1e-9 * float(gradient.abs().max()))
    torch.testing.assert_close(found.hessian, hessian, rtol=1e-9, atol=1e-9 * float(hessian.abs().max()))


@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.01, 0.1), (0.3, 0.8)])
@pytest.mark.parametrize("name", CONFIGS)
def test_hand_derived_rows_are_those_of_autograd(name: str, place: tuple[float, float], weights: bool) -> None:
    """At the state itself, near it, and so far away that rays have lost their surface and miss the bounds; and there
    again once it has been followed to."""
    config = CONFIGS[name]
    factors = {"photometric": torch.tensor([1.0, 0.5, 2.0, 0.0, 1.5], dtype=torch.float64)} if weights else None
    first, second = [], []
    for jacobian in ("analytic", "autograd"):
        _, stage, state = begun_stage(with_solver(config, jacobian=jacobian), term_weights=factors)
        there = moved(state, step_of(5, *place))
        first.append(stage.linearise(there))
        stage.follow(torch.ones(5, dtype=torch.bool))
        second.append(stage.linearise(there))
    assert max(errors(*first)) < 1e-9
    assert max(errors(*second)) < 1e-9


def test_the_terms_that_are_tracked_and_the_others() -> None:
    """The paper's form of the silhouette is always marched; with it the photometric term is tracked all the same."""
    mixed = replace(PAPER, solver=DEFAULT.solver, stages=DEFAULT.stages)
    generator = torch.Generator().manual_seed(6)
    names = ("silhouette_left", "photometric", "height")
    weights = {name: torch.rand(5, generator=generator, dtype=torch.float64) + 0.3 for name in names}
    for factors in (None, weights):
        problem, stage, state = begun_stage(mixed, term_weights=factors)
        energy = tracked(problem, state, list(problem.terms))
        others = [t.name for t, followed in zip(problem.terms, are_tracked(problem.terms), strict=True) if not followed]
        assert others == ["silhouette_left", "silhouette_right"]
        assert energy.silhouettes is None
        assert energy.photometric is not None
        reference, _, _ = begun_stage(replace(mixed, solver=PAPER.solver), term_weights=factors)
        assert max(errors(stage.linearise(state), reference.linearise(state))) < 1e-9
        _, by_autograd, _ = begun_stage(with_solver(mixed, jacobian="autograd"), term_weights=factors)
        assert max(errors(by_autograd.linearise(state), reference.linearise(state))) < 1e-8


def test_a_class_made_from_a_term_is_asked_itself() -> None:
    """It has residuals of its own, which nothing that is followed knows."""

    class Twice(PhotometricTerm):
        def weight(self) -> Tensor:
            return 2 * super().weight()

    problem, _, _ = begun_stage()
    (term,) = kind_of(problem, PhotometricTerm)
    assert are_tracked([term]) == [True]
    assert are_tracked([Twice(**{f.name: getattr(term, f.name) for f in fields(term)})]) == [False]
