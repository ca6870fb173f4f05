"""These tests check the photometric term: warp by hand, fixed sets, lost pixels, brightness, occlusion."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import CONFIGS, DEFAULT, PAPER, begun_stage, figures_at, left_of, photometric_of
from helpers.synthetic_scene import cached_street, disturbed, street
from helpers.term_cases import case
from reference import residuals as reference
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.refinement.problem import CarStage
from directshape_torch.state.cars import CarState
from directshape_torch.terms.photometric import Brightness
from directshape_torch.terms.photometric_rows import DSO_PATTERN, GRADIENT_CONSTANT, compared, residuals_at
from directshape_torch.terms.robust import huber


def _stage(config: RefinerConfig = PAPER) -> tuple[CarStage, CarState]:
    prior, scene = cached_street()
    return begun_stage(prior, scene.frames, disturbed(scene.detections, 0.05, 0.02), config)


def _translated(state: CarState, metres: list[float]) -> CarState:
    """All cars moved by a vector in the camera frame."""
    shift = -(state.T_obj_cam[:, :3, :3] @ torch.tensor(metres, dtype=torch.float64)[:, None])[..., 0]
    T = state.T_obj_cam.clone()
    T[:, :3, 3] += shift
    return CarState.of(T, state.code)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("regime", ["typical", "near", "rotated_right_camera"])
def test_residuals_at_any_depth_are_the_references_and_have_its_slope(regime: str, number: int) -> None:
    """At every pyramid level, off the surface too, as the disparity profile asks for them."""
    stage, _ = case(regime, "paper", number)
    term = photometric_of(stage)
    rows, level = term.pixel_set.rows, stage.config.image_level
    depth = term.cars.input_depth[rows.rays.owner][:, None] * (1 + 0.1 * torch.rand_like(rows.pixel_weight))
    residual, J, comparable = compared(rows, depth)
    expected, landed, in_front = reference.photometric(term, left_of(stage), level, depth)
    size = left_of(stage).pyramid[level].sizes[0]
    inside = ((landed >= 0) & (landed <= size.flip(0) - 1)).all(-1) & (in_front > 0)
    counted = comparable & (rows.pixel_weight > 0)
    assert counted.double().mean() > 0.3
    assert inside.all(-1)[counted].all()
    torch.testing.assert_close(residual[counted], expected[counted], rtol=1e-9, atol=1e-8)
    step = 1e-6 * depth.mean()
    ends = [reference.photometric(term, left_of(stage), level, depth + sign * step)[0] for sign in (1, -1)]
    error = ((ends[0] - ends[1]) / (2 * step) - J)[counted].abs()
    # A step that crosses into the next pixel sees another slope.
    assert (error < 1e-4 * J.abs().max()).double().mean() > 0.995
    several, comparable_there = residuals_at(rows, torch.stack([depth, 1.2 * depth]))
    torch.testing.assert_close(several[0], residual)
    assert torch.equal(comparable_there[0], comparable)


@pytest.mark.parametrize("config", CONFIGS)
def test_a_pixel_that_loses_its_surface_pays_the_constant(config: str) -> None:
    stage, state = _stage(CONFIGS[config])
    term, column = photometric_of(stage), 2
    gone, still = (figures_at(stage, s) for s in (_translated(state, [30.0, 0.0, 0.0]), state))
    lost = huber(torch.tensor(term.config.lost_grey_levels), term.config.huber_grey_levels).rho
    weight = term.row_weight * term.block_weight[:, None, None]
    expected = torch.stack([lost * weight[term.blocks.owner == car].sum() for car in range(2)])
    torch.testing.assert_close(gone.term_costs[:, column], expected)
    assert (gone.gradient[:, column] == 0).all()
    assert (gone.hessian[:, column] == 0).all()
    assert (expected > 2 * still.term_costs[:, column]).all()


def test_a_pixel_that_leaves_the_right_image_pays_the_constant() -> None:
    """The car comes so near that its disparity carries pixels over the left border of the right image."""
    scene = street(ellipsoid_prior(), [(-2.1, 1.65, 8.0)], [0.4])
    stage, state = begun_stage(ellipsoid_prior(), scene.frames, scene.detections, PAPER)
    term = photometric_of(stage)
    # Along its viewing ray, so that the pixels still hit it.
    nearer = _translated(state, (-0.5 * torch.linalg.inv(state.T_obj_cam[0])[:3, 3]).tolist())
    prepared = stage.problem.prepare(nearer)
    at = term.linear(prepared.field, nearer, term.anchor(prepared))
    depth, found = reference.surface_depth(stage.problem.prior, term, nearer)
    _, landed, _ = reference.photometric(term, left_of(stage), 0, torch.where(found, depth, 1.0))
    left_image = found & (landed[..., 0] < -0.5).any(-1) & (term.pixel_set.rows.pixel_weight > 0)
    assert left_image.any()
    assert (at.residual[left_image] == term.config.lost_grey_levels).all()
    assert (at.J_residual_inner[left_image] == 0).all()


def test_moving_a_car_out_of_its_mask_always_costs() -> None:
    stage, state = _stage(DEFAULT)
    truth = figures_at(stage, state).cost
    for metres in ([3.0, 0, 0], [-3.0, 0, 0], [0, 0, 6.0], [0, 0, -3.0], [40.0, 0, 0], [0, 0, 40.0]):
        assert (figures_at(stage, _translated(state, metres)).cost > truth).all()


def test_a_pixel_that_lands_on_a_nearer_cars_mask_is_not_compared() -> None:
    """In the right image the near car covers part of what the far one shows in the left image."""
    prior = ellipsoid_prior()
    scene = street(prior, [(0.9, 1.65, 6.0), (-0.2, 1.65, 13.0)], [1.5, 1.5])
    support = []
    for occlusion in (True, False):
        config = replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=occlusion))
        stage, state = begun_stage(prior, scene.frames, scene.detections, config)
        term = photometric_of(stage)
        support.append(term.pixel_set.support)
        if occlusion:
            depth, _ = reference.surface_depth(prior, term, state)
            _, landed, _ = reference.photometric(term, left_of(stage), 0, depth)
            far = (term.blocks.owner == 1)[:, None] & (term.pixel_set.rows.pixel_weight > 0)
            u, v = landed[..., DSO_PATTERN.index((0, 0)), :][far].round().long().unbind(-1)
            assert (scene.detections.mask_right.dense()[0, v, u] < 0.5).all()
    assert support[0][0] == support[1][0]
    assert support[0][1] < support[1][1]


def test_pixel_sets_and_their_weights() -> None:
    """Hits on the mask, and for the paper every hit; `c^2 / (c^2 + |grad I_l|^2)` of each."""
    for config, needs_mask in ((DEFAULT, True), (PAPER, False)):
        stage, _ = _stage(config)
        term = photometric_of(stage)
        counted = term.pixel_set.rows.pixel_weight > 0
        own = left_of(stage).packed.row.flatten()[term.pixel_set.prepared_place][counted]
        assert bool((left_of(stage).pixels.foreground[own] > 0.5).all()) is needs_mask
        assert int(counted.sum()) == int(term.pixel_set.support.sum())
        c2 = GRADIENT_CONSTANT**2
        expected = c2 / (c2 + left_of(stage).pixels.gradient_magnitude[own] ** 2)
        torch.testing.assert_close(term.pixel_set.rows.pixel_weight[counted], expected)


@pytest.mark.parametrize("change", ["darker", "flatter"])
def test_a_matched_brightness_takes_a_change_of_the_right_image_off_the_gradient(change: str) -> None:
    """20 grey levels darker, or 0.9 of the contrast about 100: the paper's residuals see both."""
    prior, scene = cached_street()
    grey = 255 * scene.frames.images_right
    changed = grey - 20 if change == "darker" else 0.9 * grey + 10
    assert 0 <= float(changed.min()) <= float(changed.max()) <= 255
    frames = replace(scene.frames, images_right=changed / 255)

    def off_by(brightness: Brightness) -> float:
        settings = replace(DEFAULT, photometric=replace(DEFAULT.photometric, brightness=brightness))
        g: list[Tensor] = []
        for each in (scene.frames, frames):
            stage, state = begun_stage(prior, each, disturbed(scene.detections, 0.05, 0.02), settings)
            g.append(figures_at(stage, state).gradient[:, 2])
        return float((g[1] - g[0]).norm() / g[0].norm())

    assert off_by("none") > 0.1
    # Residuals after the match are those of the right image, so its contrast is a factor of them, squared in g.
    assert off_by("affine") < (1e-6 if change == "darker" else 0.2)
