"""The bootstrap over cars agrees with closed forms and numpy's own statistics."""

import numpy as np
import pytest

from directshape_torch.errors import InputError
from directshape_torch.evaluation.bootstrap import CarBootstrap, Estimate


def test_interval_of_a_mean_is_that_of_the_normal_law():
    values = np.random.default_rng(3).normal(size=400)
    estimate = CarBootstrap(400, 4000).estimate(values)
    half_width = 1.96 * values.std() / np.sqrt(400)
    assert estimate.value == pytest.approx(values.mean(), abs=1e-12)
    assert estimate.low == pytest.approx(values.mean() - half_width, abs=0.1 * half_width)
    assert estimate.high == pytest.approx(values.mean() + half_width, abs=0.1 * half_width)


def test_a_change_is_that_of_the_same_cars():
    before = np.random.default_rng(4).normal(size=50)
    summary = CarBootstrap(50).summary(before, before + 0.5, np.median)
    assert summary.before == CarBootstrap(50).estimate(before, np.median)
    assert summary.before.low < np.median(before) < summary.before.high
    change = summary.change
    assert (change.value, change.low, change.high) == pytest.approx((0.5, 0.5, 0.5))


def test_seed_decides_the_interval():
    values = np.random.default_rng(6).normal(size=30)
    means = [CarBootstrap(30, seed=seed).estimate(values) for seed in (1, 1, 2)]
    assert means[0] == means[1] != means[2]
    assert CarBootstrap(1).estimate(np.array([3.0])) == Estimate(3.0, None, None)


def test_wrong_input_is_named():
    with pytest.raises(InputError, match="num_cars: expected at least 1"):
        CarBootstrap(0)
    with pytest.raises(InputError, match="num_draws: expected at least 1, got 0"):
        CarBootstrap(1, num_draws=0)
