"""A whole refinement is compiled once: other cars, other pixels and other frames find everything there.

What decides about a new compilation is the tracer in front of the compiler, so the code here is traced and then run as
it is, which takes seconds instead of the better part of a minute (`benchmark.compile_probe` counts the real ones).
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from helpers.compiled_lookup import needs_compiler, trace_only
from torch._dynamo.utils import counters

from directshape_torch.benchmark.workloads import demo_scene, with_cars
from directshape_torch.config_files import load_config
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.compiled_march import sample_grids
from directshape_torch.shape.compiled_probe import probe_grids
from directshape_torch.tracking import photometric, silhouette

FUNCTIONS = (sample_grids, probe_grids, silhouette._of_grids, photometric._of_grids)
FEW_STEPS = (
    "compile=on",
    "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 2}, "
    "{contour_width_px: 0.5, image_level: 0, max_iterations: 2}]",
)


@pytest.fixture
def _traced(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    trace_only(monkeypatch, "aot_eager")
    for function in FUNCTIONS:
        monkeypatch.setattr(function, "_forms", {})
    torch._dynamo.reset()
    counters.clear()
    yield
    torch._dynamo.reset()


def graphs() -> int:
    return int(counters["stats"]["unique_graphs"])


@needs_compiler
@pytest.mark.usefixtures("_traced")
def test_other_numbers_of_cars_and_pixels_compile_nothing_anew() -> None:
    frames = demo_scene().frames
    DirectShapeRefiner(config=load_config(None, FEW_STEPS))(*with_cars(frames, 3))
    assert [function.num_variants for function in FUNCTIONS] == [1] * len(FUNCTIONS)
    assert graphs() == len(FUNCTIONS)
    fewer_pixels = load_config(None, (*FEW_STEPS, "sampling.max_pixels=450"))
    for config, num_cars in ((load_config(None, FEW_STEPS), 1), (fewer_pixels, 2), (fewer_pixels, 8)):
        result = DirectShapeRefiner(config=config)(*with_cars(frames, num_cars))
        assert len(result.status) == num_cars
    assert graphs() == len(FUNCTIONS)
