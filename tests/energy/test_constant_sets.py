"""Within a stage pixel set, counts and zeta are fixed: what a pixel loses it pays for, and moving away never pays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import pytest
import torch
from helpers.derivatives import moved, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, PAPER, begun_problem
from helpers.synthetic_scene import cached_street, disturbed, street
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.residuals.robust import huber


def _problem(config: RefinerConfig = PAPER) -> tuple[CarProblem, CarState]:
    prior, scene = cached_street()
    return begun_problem(prior, scene.frames, disturbed(scene.detections, 0.05, 0.02), config)


def _photometric(problem: CarProblem) -> PhotometricTerm:
    return next(t for t in problem.terms if isinstance(t, PhotometricTerm))


def _translated(state: CarState, metres: list[float]) -> CarState:
    """Both cars moved by a vector in the camera frame."""
    shift = -(state.T_obj_cam[:, :3, :3] @ torch.tensor(metres, dtype=torch.float64)[:, None])[..., 0]
    T = state.T_obj_cam.clone()
    T[:, :3, 3] += shift
    return CarState(T, state.code)


def test_a_pixel_that_loses_its_hit_pays_the_constant() -> None:
    problem, state = _problem()
    term = _photometric(problem)
    assert term.fixed is not None
    gone = problem.project(_translated(state, [30.0, 0.0, 0.0]))
    lost = float(huber(torch.tensor(term.config.lost_grey_levels).double(), term.config.huber_grey_levels).rho)
    expected = lost * 8 * term.fixed.gradient_weight
    torch.testing.assert_close(term.pixel_cost(gone), expected)
    part = term.linearise(gone)
    assert (part.gradient == 0).all()
    assert (part.hessian == 0).all()
    torch.testing.assert_close(part.cost, term.cost(gone), rtol=1e-12, atol=0)
    assert (part.cost > 5 * term.cost(problem.project(state))).all()


def test_the_number_of_pixels_and_their_order_stay() -> None:
    problem, state = _problem()
    term = _photometric(problem)
    for metres in (0.0, 0.1, 0.5, 2.0):
        assert len(term.pixel_cost(problem.project(_translated(state, [metres, 0.0, 0.0])))) == len(
            term.pixel_cost(problem.project(state))
        )


def test_a_pixel_that_leaves_the_right_image_pays_the_constant() -> None:
    """The car comes so near that its disparity carries pixels over the left border of the right image."""
    prior = ellipsoid_prior()
    scene = street(prior, [(-2.1, 1.65, 8.0)], [0.4])
    problem, state = begun_problem(prior, scene.frames, scene.detections, PAPER)
    term = _photometric(problem)
    direction = torch.linalg.inv(state.T_obj_cam[0])[:3, 3]
    nearer = _translated(state, (-0.5 * direction).tolist())  # along its viewing ray, so that the pixels still hit it
    usable, residual = term._usable_and_residual(problem.project(nearer))
    left_image = ~residual.inside
    assert left_image.any()
    assert not usable[left_image].any()
    cost = term.pixel_cost(problem.project(nearer))
    assert term.fixed is not None
    lost = float(huber(torch.tensor(term.config.lost_grey_levels).double(), term.config.huber_grey_levels).rho)
    torch.testing.assert_close(cost[left_image], 8 * lost * term.fixed.gradient_weight[left_image])


def test_a_pixel_that_lands_on_a_nearer_cars_mask_is_excluded() -> None:
    prior = ellipsoid_prior()
    # In the right image the near car covers part of what the far one shows in the left image.
    scene = street(prior, [(0.9, 1.65, 6.0), (-0.2, 1.65, 13.0)], [1.5, 1.5])
    with_order = DEFAULT
    without = replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=False))
    counts = []
    for config in (with_order, without):
        problem, state = begun_problem(prior, scene.frames, scene.detections, config)
        term = _photometric(problem)
        assert term.fixed is not None
        counts.append(term.fixed.segments.counts)
        if config is with_order:
            uv = term._residual(problem.project(state).left.surface(term.fixed.pixel_index)[1].depth).uv_right
            u, v = uv[term.fixed.object_index == 1].round().long().unbind(1)
            assert (scene.detections.mask_right[0, v, u] < 0.5).all()
    assert counts[0][0] == counts[1][0]
    assert counts[0][1] < counts[1][1]


def test_default_pixel_set_is_hit_and_foreground_and_the_papers_is_every_hit() -> None:
    for config, needs_mask in ((DEFAULT, True), (PAPER, False)):
        problem, state = _problem(config)
        term = _photometric(problem)
        assert term.fixed is not None
        foreground = term.pixels.foreground[term.fixed.pixel_index]
        assert bool((foreground > 0.5).all()) is needs_mask
        usable, _ = term._usable_and_residual(problem.project(state))
        assert usable.all()


def test_gradient_weight_is_that_of_the_left_image() -> None:
    problem, _ = _problem()
    term = _photometric(problem)
    assert term.fixed is not None
    c2 = term.config.gradient_constant_grey_levels**2
    magnitude = term.pixels.gradient_magnitude[term.fixed.pixel_index]
    torch.testing.assert_close(term.fixed.gradient_weight, c2 / (c2 + magnitude**2))


def test_the_photometric_term_needs_a_stage() -> None:
    prior, scene = cached_street()
    from directshape_torch.refiner import DirectShapeRefiner

    problem, state = DirectShapeRefiner(prior, DEFAULT).problem(scene.frames, scene.detections)
    with pytest.raises(RuntimeError, match="at_stage"):
        problem.cost(state)


def test_zeta_comes_from_the_input_depth_and_not_from_the_state() -> None:
    problem, state = _problem()
    scene = cached_street()[1]
    term = next(t for t in problem.terms if isinstance(t, SilhouetteTerm))
    depth = disturbed(scene.detections, 0.05, 0.02).T_cam_obj[:, 2, 3]
    expected = (150.0 / (depth * 0.5)).clamp(term.config.min_zeta_per_m, term.config.max_zeta_per_m)
    torch.testing.assert_close(term.zeta, expected[term.pixels.object_index])
    problem.begin_stage(problem.stages()[1], _translated(state, [0.0, 0.0, 3.0]))
    later = next(t for t in problem.terms if isinstance(t, SilhouetteTerm))
    assert (later.zeta == term.zeta).all()
    problem.begin_stage(problem.stages()[0], state)
    softer = next(t for t in problem.terms if isinstance(t, SilhouetteTerm))
    torch.testing.assert_close(softer.zeta, term.zeta / 4)


SOFT = replace(DEFAULT.silhouette, min_zeta_per_m=0.2, max_zeta_per_m=0.2)


@pytest.mark.parametrize("form", ["closest_approach", "product"])
def test_a_ray_that_misses_the_bounds_counts_as_background(form: Literal["closest_approach", "product"]) -> None:
    """However soft the contour: so soft here that the distance alone would still give a gradient."""
    problem, state = _problem(replace(DEFAULT, silhouette=replace(SOFT, form=form)))
    gone = problem.project(_translated(state, [25.0, 0.0, 0.0]))
    for term in problem.terms:
        if isinstance(term, SilhouetteTerm):
            expected = -torch.log(1 - term.foreground)
            torch.testing.assert_close(term.pixel_residual(gone), expected)
            torch.testing.assert_close(term.residual_at(term.view(gone)), expected)
            assert (term.linearise(gone).gradient == 0).all()


def test_moving_a_car_out_of_its_mask_always_costs() -> None:
    problem, state = _problem(DEFAULT)
    truth = problem.cost(state)
    for metres in ([3.0, 0, 0], [-3.0, 0, 0], [0, 0, 6.0], [0, 0, -3.0], [40.0, 0, 0], [0, 0, 40.0]):
        assert (problem.cost(_translated(state, metres)) > truth).all()


def _same(a: Tensor, b: Tensor) -> None:
    torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("config", [DEFAULT, PAPER])
@pytest.mark.parametrize("keep", [[True, False], [False, True], [True, True], [False, False]])
def test_compaction_changes_no_number(config: RefinerConfig, keep: list[bool]) -> None:
    problem, state = _problem(config)
    kept = torch.tensor(keep)
    part = problem.compact(kept)
    at = moved(state, 0.01 * torch.ones_like(tangent_of(state)))
    reduced = CarState(at.T_obj_cam[kept], at.code[kept])
    for full, small in zip(
        problem.linearise_terms(at, with_fisher=True), part.linearise_terms(reduced, with_fisher=True), strict=True
    ):
        for x, y in zip(full, small, strict=True):
            _same(x[kept], y)
    _same(problem.term_costs(at)[kept], part.term_costs(reduced))


def test_a_fresh_stage_after_compaction_equals_one_without() -> None:
    problem, state = _problem(DEFAULT)
    kept = torch.tensor([False, True])
    part = problem.compact(kept)
    reduced = CarState(state.T_obj_cam[kept], state.code[kept])
    for stage in problem.stages():
        problem.begin_stage(stage, state)
        part.begin_stage(stage, reduced)
        _same(problem.cost(state)[kept], part.cost(reduced))


def test_gain_brings_the_left_image_to_the_brightness_of_the_right_one() -> None:
    prior, scene = cached_street()
    darker = replace(scene.frames, images_right=0.9 * scene.frames.images_right)
    intensities = []
    for frames in (scene.frames, darker):
        problem, _ = begun_problem(prior, frames, scene.detections, DEFAULT)
        fixed = _photometric(problem).fixed
        assert fixed is not None
        intensities.append(fixed.intensity_left)
    torch.testing.assert_close(intensities[1], 0.9 * intensities[0])
    plain, _ = begun_problem(prior, darker, scene.detections, PAPER)
    level = 255 * scene.frames.images_left.mean(1)
    fixed, term = _photometric(plain).fixed, _photometric(plain)
    assert fixed is not None
    u, v = term.pixels.uv[fixed.pixel_index].long().unbind(1)
    torch.testing.assert_close(fixed.intensity_left[:, 4], level[0, v, u])


@pytest.mark.parametrize("change", ["darker", "flatter"])
def test_forms_that_do_not_see_a_change_of_the_right_image_have_the_same_gradient(change: str) -> None:
    """20 grey levels darker, or 0.9 of the contrast about 100: the paper's residuals see both, the others not."""
    prior, scene = cached_street()
    grey = 255 * scene.frames.images_right
    changed = grey - 20 if change == "darker" else 0.9 * grey + 10
    assert 0 <= float(changed.min()) <= float(changed.max()) <= 255
    frames = replace(scene.frames, images_right=changed / 255)

    def off_by(**photometric: Any) -> float:
        settings = replace(DEFAULT, photometric=replace(DEFAULT.photometric, **{"brightness": "none", **photometric}))
        g = []
        for each in (scene.frames, frames):
            problem, state = begun_problem(prior, each, disturbed(scene.detections, 0.05, 0.02), settings)
            g.append(_photometric(problem).linearise(problem.project(state)).gradient)
        return float((g[1] - g[0]).norm() / g[0].norm())

    assert off_by() > 0.1
    # Residuals after the match are those of the right image, so its contrast is a factor of them, squared in g.
    assert off_by(brightness="affine") < (1e-6 if change == "darker" else 0.2)
    assert off_by(patch="normalised", contrast_floor_grey_levels=0.1) < 1e-2
    assert (off_by(patch="zero_mean") < 1e-9) is (change == "darker")
