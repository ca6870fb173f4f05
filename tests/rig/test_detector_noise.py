"""The errors of a detector are found from the distances of results from its boxes."""

from __future__ import annotations

import pytest
import torch
from helpers.rig_rows import estimate
from torch import Tensor

from directshape_torch import RigEstimate
from directshape_torch.errors import InputError
from directshape_torch.refinement.fusion import UNKNOWN_DETECTOR
from directshape_torch.rig.detector_noise import detector_sigmas, in_words
from directshape_torch.rig.rigs import RigEstimates

# Standard deviations: depth as a share of the distance; sideways, height, heading (times 2 m), length, width and height
# in metres.
LIDAR = torch.tensor([0.003, 0.04, 0.03, 0.04, 0.2, 0.05, 0.05], dtype=torch.float64)
MONO = torch.tensor([0.06, 0.25, 0.1, 0.3, 0.5, 0.12, 0.12], dtype=torch.float64)
IMAGES = torch.tensor([0.15, 0.05, 0.05, 0.06, 0.2, 0.06, 0.05], dtype=torch.float64)
SHOWN = torch.tensor([0.77, 0.77, 0.77, 0.77, 0.5, 0.5, 0.5], dtype=torch.float64)


def rows_of(noise: Tensor, count: int, seed: int = 0) -> Tensor:
    """Comparisons of results that show as much of a detector's errors as is known of them."""
    generator = torch.Generator().manual_seed(seed)
    distance = 8 + 30 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    draws = torch.randn(2, count, 7, generator=generator, dtype=torch.float64)
    # Student's t with 4 degrees of freedom: boxes and results that are far off are more than a normal error has.
    draws = draws / torch.randn(4, count, 1, generator=generator, dtype=torch.float64).square().mean(dim=0).sqrt()
    units = torch.cat([distance, torch.ones(count, 6, dtype=torch.float64)], dim=1)
    difference = SHOWN * noise * units * draws[0] + IMAGES * draws[1]
    return torch.cat([distance, difference, IMAGES.expand(count, 7)], dim=1)


@pytest.mark.parametrize("noise", [MONO, 0.5 * MONO])
def test_noise_that_stands_out_of_the_images_is_found(noise: Tensor) -> None:
    ratio = detector_sigmas(rows_of(noise, 600)) / noise
    assert ratio.min() > 0.75
    assert ratio.max() < 1.25


def test_a_good_detector_is_told_from_a_guess_by_a_hundred_cars() -> None:
    good, guess = (detector_sigmas(rows_of(noise, 100)) for noise in (LIDAR, MONO))
    assert (good < 0.8 * guess).all()
    assert good[0] < 0.008
    assert good[3] < 0.1


def test_of_a_single_car_the_prior_decides_most() -> None:
    one = detector_sigmas(rows_of(LIDAR, 1))
    assert ((one > 0.2 * SHOWN.reciprocal() * torch.tensor([0.02, 0.12, 0.06, 0.16, 0.35, 0.08, 0.08])).all()).item()


def test_without_results_a_detector_is_as_most_are() -> None:
    nothing = detector_sigmas(torch.zeros(0, 15, dtype=torch.float64))
    torch.testing.assert_close(nothing, UNKNOWN_DETECTOR, rtol=0.01, atol=0)


def test_words_name_every_quantity_with_its_unit() -> None:
    assert in_words(MONO) == (
        "depth 6.0 %, sideways 0.25 m, height above ground 0.10 m, heading 8.6 deg, "
        "length 0.50 m, width 0.12 m, height 0.12 m"
    )


def test_an_estimate_keeps_its_results() -> None:
    rig = estimate()
    assert rig.detector_sigmas() is None
    rig.add_results(rows_of(LIDAR, 30))
    for _ in range(3):  # the same again says nothing new
        rig.add_results(rows_of(LIDAR, 20, seed=1))
    sigmas = rig.detector_sigmas()
    assert sigmas is not None
    assert len(rig.results) == 50
    again = estimate()
    again.load_state_dict(rig.state_dict())
    assert again.results.equal(rig.results)
    # What was saved before results were known.
    before = {name: value for name, value in rig.content().items() if name != "results"}
    assert RigEstimate.of_content(before).detector_sigmas() is None


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (torch.ones(2, 14), r"rows: expected shape \(N, 15\), got \(2, 14\)"),
        (torch.full((2, 15), torch.nan), "rows: expected finite differences and standard deviations above 0"),
        (torch.zeros(2, 15), "rows: expected finite differences and standard deviations above 0"),
    ],
)
def test_wrong_rows_are_named(rows: Tensor, text: str) -> None:
    with pytest.raises(InputError, match=text):
        estimate().add_results(rows)


def test_one_detector_looks_through_all_rigs() -> None:
    first, second = estimate(), estimate()
    rigs = RigEstimates([first, second])
    assert rigs.detector_sigmas() is None
    first.add_results(rows_of(LIDAR, 30))
    second.add_results(rows_of(LIDAR, 20, seed=1))
    both = rigs.detector_sigmas()
    assert both is not None
    torch.testing.assert_close(both, detector_sigmas(torch.cat([rows_of(LIDAR, 30), rows_of(LIDAR, 20, seed=1)])))
