"""Neighbourhoods without brightness and contrast, and one brightness for both images of a car."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from directshape_torch.terms.photometric import Brightness, matched_brightness
from directshape_torch.terms.photometric_rows import PatchForm, patch_derivative, patch_residual

FLOOR = 5.0
FORMS: tuple[PatchForm, ...] = ("plain", "zero_mean", "normalised")


def _patches(count: int = 6, seed: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Left and right grey levels (P, 8), and weights of which each neighbourhood lacks another one."""
    generator = torch.Generator().manual_seed(seed)
    left, right = (60 + 120 * torch.rand(count, 8, generator=generator, dtype=torch.float64) for _ in range(2))
    weight = torch.ones(count, 8, dtype=torch.float64)
    weight[torch.arange(count), torch.arange(count) % 8] = 0
    return left, right, weight


def test_patches_by_hand() -> None:
    left = torch.tensor([[10.0, 20.0, 30.0, 999.0]], dtype=torch.float64)
    right = torch.tensor([[7.0, 4.0, 1.0, -999.0]], dtype=torch.float64)
    weight = torch.tensor([[1.0, 1.0, 1.0, 0.0]], dtype=torch.float64)
    residual = right - left
    assert patch_residual(residual, left, weight, "plain", FLOOR) is residual
    # Means 20 and 4: (3, 0, -3) - (-10, 0, 10).
    without_brightness = patch_residual(residual, left, weight, "zero_mean", FLOOR)[:, :3]
    torch.testing.assert_close(without_brightness, torch.tensor([[13.0, 0.0, -13.0]], dtype=torch.float64))
    # Variances 200/3 and 6; with a floor of 2: (200/3 + 4) / (6 + 4) = 7.0666...
    normalised = patch_residual(residual, left, weight, "normalised", 2.0)[:, :3]
    middle = 3 * (212 / 30) ** 0.5 + 10
    torch.testing.assert_close(normalised, torch.tensor([[middle, 0.0, -middle]], dtype=torch.float64))


@given(st.floats(-80, 80), st.floats(0.3, 3.0))
@settings(max_examples=25, deadline=None)
def test_brightness_and_contrast_are_not_seen(offset: float, gain: float) -> None:
    left, right, weight = _patches()

    def residual(form: PatchForm, changed: Tensor, floor: float) -> Tensor:
        return weight * patch_residual(changed - left, left, weight, form, floor)

    for form in ("zero_mean", "normalised"):
        torch.testing.assert_close(residual(form, right + offset, FLOOR), residual(form, right, FLOOR))
    same = residual("normalised", gain * right + offset, 1e-6)
    torch.testing.assert_close(same, residual("normalised", right, 1e-6), rtol=1e-9, atol=1e-6)
    assert float(residual("normalised", gain * left + offset, 1e-6).abs().max()) < 1e-6


def test_neighbours_off_the_car_change_nothing() -> None:
    left, right, weight = _patches()
    other = torch.where(weight > 0, right, -right)
    J = right.flip(1)
    for form in FORMS:
        a, b = (
            (weight * patch_residual(x - left, left, weight, form, FLOOR),
             weight * patch_derivative(J, x - left, left, weight, form, FLOOR)) for x in (right, other)
        )  # fmt: skip
        torch.testing.assert_close(a, b)


def test_noise_without_texture_is_not_blown_up() -> None:
    """On an even left neighbourhood residuals stay below the floor's sqrt(7) fold, the most that seven can deviate."""
    left, right, weight = _patches()
    even = torch.full_like(left, 100.0)
    found = patch_residual(right - even, even, weight, "normalised", FLOOR)
    assert ((weight * found).abs() < FLOOR * 7**0.5).all()
    J = right - 120
    derivative = patch_derivative(J, even - left, left, weight, "normalised", FLOOR)
    mean = (weight * J).sum(1, keepdim=True) / 7
    deviation = ((weight * (left - (weight * left).sum(1, keepdim=True) / 7) ** 2).sum(1, keepdim=True) / 7).sqrt()
    torch.testing.assert_close(derivative, (deviation**2 + FLOOR**2).sqrt() / FLOOR * (J - mean))


@pytest.mark.parametrize("floor", [0.5, FLOOR, 60.0])
@pytest.mark.parametrize("form", FORMS)
def test_derivative_by_the_depth_three_ways(form: PatchForm, floor: float) -> None:
    left, right, weight = _patches()
    slope = _patches(seed=8)[1] - 120

    def residual(depth: Tensor) -> Tensor:
        moved = right + depth[:, None] * slope + 30 * torch.sin(depth)[:, None] ** 2
        return patch_residual(moved - left, left, weight, form, floor)

    zero = torch.zeros(len(left), dtype=torch.float64)
    by_hand = patch_derivative(slope, right - left, left, weight, form, floor)
    _, by_autograd = torch.func.jvp(residual, (zero,), (torch.ones_like(zero),))
    step = 1e-5
    numeric = (residual(zero + step) - residual(zero - step)) / (2 * step)
    torch.testing.assert_close(by_hand, by_autograd, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(by_hand, numeric, rtol=1e-6, atol=1e-6)


CAR = torch.tensor([0] * 30 + [1] * 20)


def _left() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    weight = (torch.rand(50, 8, generator=generator, dtype=torch.float64) > 0.2).double()
    return 40 + 120 * torch.rand(50, 8, generator=generator, dtype=torch.float64), weight


def _matched(form: Brightness, left: Tensor, right: Tensor, weight: Tensor) -> Tensor:
    """Rows (P, 8), each pixel a block of its own; the third car has no pixels."""
    of_blocks = [x.mT[..., None] for x in (left, right, weight)]
    found = matched_brightness(form, of_blocks[0], of_blocks[1], of_blocks[2], CAR, 3)
    return found[..., 0].mT


def test_known_changes_are_found_car_by_car() -> None:
    left, weight = _left()
    gain, offset = torch.tensor([0.9, 1.2]).double()[CAR, None], torch.tensor([14.0, -30.0]).double()[CAR, None]
    assert torch.equal(_matched("none", left, left + 1, weight), left)
    torch.testing.assert_close(_matched("gain", left, gain * left, weight), gain * left)
    changed = gain * left + offset
    # The floor of the contrast draws the factor towards one: 5 against 35 grey levels, by two percent of what is off.
    torch.testing.assert_close(_matched("affine", left, changed, weight), changed, rtol=0, atol=0.5)


def test_pixels_need_not_lie_on_their_counterparts() -> None:
    """Moments of the car, not a regression: that would take all contrast off a right image of which nothing matches."""
    left, weight = _left()
    weight = torch.ones_like(weight)
    shuffled = left.clone()
    for car in (0, 1):
        own = car == CAR
        order = torch.randperm(int(own.sum()) * 8, generator=torch.Generator().manual_seed(car))
        shuffled[own] = left[own].flatten()[order].view(-1, 8)
    torch.testing.assert_close(_matched("affine", left, shuffled, weight), left)


def test_what_is_not_on_the_car_does_not_count() -> None:
    left, weight = _left()
    right = 1.1 * left + 5
    strange = torch.where(weight > 0, right, torch.full_like(right, 1e4))
    for form in ("gain", "affine"):
        torch.testing.assert_close(_matched(form, left, strange, weight), _matched(form, left, right, weight))


def test_what_no_two_cameras_differ_by_is_bounded() -> None:
    left, weight = _left()
    torch.testing.assert_close(_matched("gain", left, 3 * left, weight), 1.25 * left)
    torch.testing.assert_close(_matched("gain", 0 * left, left, weight), 0 * left)
    mean = (weight * left).view(-1)[: 30 * 8].sum() / weight[:30].sum()
    bounded = _matched("affine", left, 0.1 * left, weight)[:30]
    torch.testing.assert_close(bounded, 0.8 * (left[:30] - mean) + 0.1 * mean)


def test_an_even_car_keeps_its_noise() -> None:
    left, weight = _left()
    even = 100 + 0.01 * left
    found = _matched("affine", even, 110 + 0.02 * left, weight)
    for car in (0, 1):
        spread = found[car == CAR].std() / even[car == CAR].std()
        assert 1 < float(spread) < 1.02
        counted = weight[car == CAR] > 0
        expected = 110 + 0.02 * left[car == CAR][counted].mean()
        torch.testing.assert_close(found[car == CAR][counted].mean(), expected)


@pytest.mark.parametrize("form", ["gain", "affine"])
def test_it_follows_both_images(form: Brightness) -> None:
    left, weight = _left()
    right = (1.1 * left + 7).flip(1)
    inputs = tuple(x.requires_grad_() for x in (left, right.detach()))
    assert torch.autograd.gradcheck(lambda a, b: _matched(form, a, b, weight)[::9], inputs)
