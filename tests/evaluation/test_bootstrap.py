"""Bootstrap over cars: against closed forms and a plain loop."""

import numpy as np
import pytest

from directshape_torch.errors import InputError
from directshape_torch.evaluation.bootstrap import (
    BootstrapSettings,
    CarBootstrap,
    Estimate,
    weighted_mean,
    weighted_median,
)


def test_interval_of_a_mean_is_that_of_the_normal_law():
    values = np.random.default_rng(3).normal(size=400)
    estimate = CarBootstrap(400, BootstrapSettings(4000)).estimate(values, weighted_mean)
    half_width = 1.96 * values.std() / np.sqrt(400)
    assert estimate.value == pytest.approx(values.mean(), abs=1e-12)
    assert estimate.low == pytest.approx(values.mean() - half_width, abs=0.1 * half_width)
    assert estimate.high == pytest.approx(values.mean() + half_width, abs=0.1 * half_width)


def test_weighted_median_equals_numpy_on_repeated_values():
    generator = np.random.default_rng(5)
    for _ in range(50):
        values = generator.normal(size=generator.integers(1, 9))
        weights = generator.integers(0, 4, size=len(values))
        weights[0] += 1
        expected = np.median(np.repeat(values, weights))
        assert weighted_median(values, weights[None].astype(float))[0] == pytest.approx(expected)
    assert weighted_median(np.array([1.0, 2.0, 6.0]), np.full((1, 3), 1 / 3))[0] == 2.0


def test_one_car_has_no_interval():
    assert CarBootstrap(1).estimate(np.array([3.0]), weighted_mean) == Estimate(3.0, None, None)


def test_seed_decides_the_interval_and_chunks_do_not(monkeypatch: pytest.MonkeyPatch):
    values = np.random.default_rng(6).normal(size=30)
    draws = [CarBootstrap(30, BootstrapSettings(seed=seed)) for seed in (1, 1, 2)]
    whole = draws[0].estimate(values, weighted_median)
    assert whole == draws[1].estimate(values, weighted_median)
    means = [one.estimate(values, weighted_mean) for one in draws]
    assert means[0] == means[1] != means[2]
    monkeypatch.setattr("directshape_torch.evaluation.bootstrap._CHUNK_ELEMENTS", 100)
    assert whole == draws[0].estimate(values, weighted_median)


def test_wrong_input_is_named():
    with pytest.raises(InputError, match="num_cars: expected at least one"):
        CarBootstrap(0)
    with pytest.raises(InputError, match="num_draws, confidence"):
        BootstrapSettings(confidence=1.0)
