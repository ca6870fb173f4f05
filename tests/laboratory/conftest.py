"""This file builds small benches anew for each test, so that a mutated function is seen; two codes keep them fast.

Three cars are used, because with two cars the second one is also the last, so that an index counted backwards would not
be noticed.
"""

from __future__ import annotations

from functools import cache

import pytest
from helpers.priors import first_components

from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.scenes import LaboratoryScene, load_scene
from directshape_torch.shape.pca_prior import PCAShapePrior


@cache
def small_prior() -> PCAShapePrior:
    return first_components(PCAShapePrior.load_bundled().double(), 2)


@cache
def demo_scene() -> LaboratoryScene:
    return load_scene()


def small_bench(regime: str, states: int = 3, pixels: int = 7) -> Bench:
    return Bench.build(demo_scene(), small_prior(), REGIMES[regime], states, pixels_per_car=pixels)


@pytest.fixture
def bench_of():  # type: ignore[no-untyped-def]
    return small_bench


@pytest.fixture
def scene() -> LaboratoryScene:
    return demo_scene()


@pytest.fixture
def prior() -> PCAShapePrior:
    return small_prior()
