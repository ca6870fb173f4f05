"""This file has benches of the laboratory for the comparison of native loops with tensor operations."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import pytest
import torch

from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.scenes import load_scene
from directshape_torch.shape.pca_prior import PCAShapePrior


@cache
def _bench_of(regime: str) -> Bench:
    return Bench.build(load_scene(), PCAShapePrior.load_bundled().double(), REGIMES[regime], 3, pixels_per_car=100)


SHORT = ("typical", "near_3m", "far_80m", "grazing", "contour", "grid_border", "track")


@pytest.fixture(params=[pytest.param(name, marks=[] if name in SHORT else pytest.mark.long) for name in REGIMES])
def bench(request: pytest.FixtureRequest) -> Bench:
    """Three states of each regime in turn, float64."""
    return _bench_of(request.param)


@pytest.fixture
def no_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


@pytest.fixture
def typical() -> Bench:
    return _bench_of("typical")
