"""Slopes, and that a sweep of two sizes gives its rows and curves."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from directshape_torch.benchmark.rows import Curve
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.suite_scaling import Sweep, measure, slope, sweeps
from directshape_torch.benchmark.timing import Repetitions
from directshape_torch.benchmark.workloads import demo_scene
from directshape_torch.refiner import DirectShapeRefiner


@pytest.mark.parametrize("power", [-1.0, 0.0, 0.5, 1.0, 2.0])
def test_the_slope_of_a_power_is_the_power(power: float) -> None:
    x = [1.0, 3.0, 10.0, 50.0]

    assert slope(x, [7 * value**power for value in x]) == pytest.approx(power, abs=1e-12)


def test_the_sweeps_are_those_of_the_documentation() -> None:
    found = sweeps(demo_scene().frames[0])

    assert [sweep.name for sweep in found] == ["cars", "pixels", "samples", "codes", "iterations", "frame size"]
    assert max(found[0].sizes) == 100


@pytest.mark.parametrize("name", ["pixels", "codes"])
def test_a_sweep_varies_what_it_says(name: str) -> None:
    (sweep,) = (s for s in sweeps(demo_scene().frames[0]) if s.name == name)

    counts = []
    for size in sweep.quick_sizes:
        problem, state = (parts := sweep.make("eager", size))[0].problem(*parts[1:])
        counts.append(len(problem.left) if name == "pixels" else state.code.shape[1])

    assert counts[1] > 1.5 * counts[0]


class Zeros(DirectShapeRefiner):
    """Makes as many numbers as it is asked to, instead of refining."""

    def forward(self, frames: Any, detections: Any, term_weights: Any = None) -> Any:
        return torch.zeros(frames, detections)


def test_rows_and_curves_of_a_sweep() -> None:
    refiner = Zeros()
    sweep = Sweep("cars", "cars in a call", (1, 2, 4, 8), (1, 2), lambda _, size: (refiner, 1000 * size, 10))

    rows, curves = measure(sweep, "eager", SuiteSettings(quick=False, repetitions=Repetitions(1, 2)))

    values = {row.name: row.value for row in rows}
    assert values["memory over cars"] == pytest.approx(1.0)
    assert values["8 cars in one call, peak memory of tensors"] == pytest.approx(8 * 40_000 / 2**20)
    assert values["memory of a further car"] == pytest.approx(40_000 / 2**20)
    assert [(type(c), c.y_label, c.x) for c in curves] == [
        (Curve, "time [ms]", (1.0, 2.0, 4.0, 8.0)),
        (Curve, "peak memory [MB]", (1.0, 2.0, 4.0, 8.0)),
    ]
