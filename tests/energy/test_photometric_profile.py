"""The photometric cost over offsets of the disparity, against the residuals of the term evaluated one by one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import CONFIGS, begun_problem
from helpers.synthetic_scene import Street, cached_street, disturbed, joined_detections, joined_frames, street
from torch import Tensor

from directshape_torch import photometric_match
from directshape_torch.disparity_profile import disparity_profile
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.residuals.photometric import DSO_PATTERN, photometric_residual
from directshape_torch.residuals.photometric_profile import DisparityResiduals, residuals_on_lines, warp_lines
from directshape_torch.scene import Detections, FrameBatch

OFFSETS = torch.linspace(-3, 3, 13, dtype=torch.float64)


def photometric_of(problem: CarProblem) -> PhotometricTerm:
    return next(term for term in problem.terms if isinstance(term, PhotometricTerm))


def curve(problem: CarProblem, state: CarState, offsets_px: Tensor) -> Tensor:
    """Costs (B, n) of all pixels."""
    return disparity_profile(problem, state, state, offsets_px, max_pixels=10**6).cost_after


def begun(frames: FrameBatch, detections: Detections, config: str = "default") -> tuple[CarProblem, CarState]:
    return begun_problem(ellipsoid_prior(), frames, detections, CONFIGS[config])


@cache
def two_cars() -> Street:
    return cached_street()[1]


@pytest.mark.parametrize("config", ["default", "truncated", "paper", "normalised"])
def test_at_no_offset_it_is_the_cost(config: str) -> None:
    problem, state = begun(two_cars().frames, disturbed(two_cars().detections), config)
    found = curve(problem, state, torch.zeros(1))
    expected = photometric_of(problem).cost(problem.project(state)).detach()
    torch.testing.assert_close(found[:, 0], expected, rtol=1e-10, atol=0)


def _residual_inputs(level_scale: float, bias: bool) -> tuple[list[Tensor | float | int | None], Tensor]:
    """Made-up arguments of `photometric_residual` for 200 pixels in two frames, and their depth."""
    generator = torch.Generator().manual_seed(2)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    images, count = 255 * uniform(2, 60, 80), 200
    sizes = torch.tensor([[60, 80], [50, 70]])
    frame = (uniform(count) > 0.5).long()
    K = torch.tensor([[150.0, 0, 60], [0, 140.0, 45], [0, 0, 1]]).double().expand(count, 3, 3)
    T = torch.eye(4, dtype=torch.float64)
    angle = torch.tensor(0.01).double()
    T[0, 0], T[0, 2], T[2, 0], T[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    T[:3, 3] = torch.tensor([-0.53, 0.01, 0.02], dtype=torch.float64)
    centre = uniform(count, 1, 2) * torch.tensor([180.0, 140.0]).double() - 10
    uv = centre + torch.tensor(DSO_PATTERN).double()
    rays = torch.cat([(uv - K[0, :2, 2]) / K[0, [0, 1], [0, 1]], torch.ones(count, 8, 1).double()], dim=-1)
    shifts = (uniform(count) - 0.5, 0.2 * uniform(count)) if bias else (None, None)
    depth = 4 + 30 * uniform(count)
    before: list[Tensor | float | int | None] = [images, sizes, level_scale, frame, 255 * uniform(count, 8), rays]
    return [*before, depth, K, T.expand(count, 4, 4), *shifts, DSO_PATTERN.index((0, 0))], depth


def _on_lines(inputs: list[Any]) -> DisparityResiduals:
    images, sizes, level_scale, frame, left, rays, depth, *cameras, centre = inputs
    lines = warp_lines(level_scale, rays, *cameras)
    return residuals_on_lines(lines, depth, images, sizes, level_scale, frame, left, centre, OFFSETS)


@pytest.mark.parametrize("level_scale", [1.0, 0.5])
@pytest.mark.parametrize("bias", [False, True])
def test_residuals_are_those_at_depths_moved_one_by_one(level_scale: float, bias: bool) -> None:
    """Two frames of different size, a right camera turned against the left one, half of the pixels outside."""
    inputs, depth = _residual_inputs(level_scale, bias)
    found = _on_lines(inputs)
    seen_inside = []
    for i, offset in enumerate(OFFSETS):
        share = 1 + offset * depth / (150.0 * 0.53)
        expected = photometric_residual(*inputs[:6], depth / share, *inputs[7:])  # type: ignore[arg-type]
        inside = expected.inside & (share > 0)
        assert torch.equal(found.inside[i], inside)
        torch.testing.assert_close(found.residual[i][inside], expected.residual[inside], rtol=0, atol=1e-9)
        torch.testing.assert_close(found.uv_right[i][inside], expected.uv_right[inside], rtol=0, atol=1e-9)
        seen_inside.append(inside.double().mean())
    assert 0.1 < float(torch.stack(seen_inside).mean()) < 0.9


def test_the_batch_is_the_loop_and_padding_changes_nothing() -> None:
    first = two_cars()
    second = street(ellipsoid_prior(), [(0.4, 1.65, 9.0)], [0.9], size_wh=(150, 110))
    frames = joined_frames([first.frames, second.frames])
    detections = joined_detections([first.detections, second.detections], (120, 160))
    problem, state = begun(frames, detections)
    together = curve(problem, state, OFFSETS)
    for scene, rows in ((first, slice(0, 2)), (second, slice(2, 3))):
        problem, state = begun(scene.frames, scene.detections)
        alone = curve(problem, state, OFFSETS)
        torch.testing.assert_close(together[rows], alone, rtol=1e-9, atol=1e-9)


def test_a_few_offsets_at_a_time_are_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state = begun(two_cars().frames, two_cars().detections)
    together = curve(problem, state, OFFSETS)
    monkeypatch.setattr(photometric_match, "_RESIDUALS_AT_ONCE", 1)
    assert torch.equal(together, curve(problem, state, OFFSETS))


def test_a_car_without_pixels_has_no_cost_and_touches_no_other() -> None:
    scene = two_cars()
    masks = scene.detections.mask_left.clone()
    masks[0] = 0
    problem, state = begun(scene.frames, replace(scene.detections, mask_left=masks))
    found = curve(problem, state, OFFSETS)
    assert found[0].isnan().all()
    assert found[1].isfinite().all()


def test_no_cars() -> None:
    scene = two_cars()
    problem, state = begun(scene.frames, scene.detections)
    none = problem.compact(torch.zeros(2, dtype=torch.bool))
    empty = CarState(*(part[:0] for part in state))
    assert curve(none, empty, OFFSETS).shape == (0, 13)
