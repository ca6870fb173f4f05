"""One brightness match serves both images of a car."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from directshape_torch.terms.photometric import Brightness, matched_brightness

CAR = torch.tensor([0] * 30 + [1] * 20)


def _left() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    weight = (torch.rand(50, 8, generator=generator, dtype=torch.float64) > 0.2).double()
    return 40 + 120 * torch.rand(50, 8, generator=generator, dtype=torch.float64), weight


def _matched(form: Brightness, left: Tensor, right: Tensor, weight: Tensor) -> Tensor:
    """Rows (P, 8) with a block for each pixel; the third car has no pixels."""
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
