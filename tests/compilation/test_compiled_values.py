"""Every compiled function against its plain form, on all that a refinement asks of it.

What the compiler does with memory depends on the whole of a function and on the sizes it is given, so nothing smaller
than the real functions with real arguments tells whether their code is right.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from helpers.compiled_lookup import needs_compiler
from torch import Tensor
from torch.utils._pytree import tree_leaves

from directshape_torch.benchmark.workloads import demo_scene, with_cars
from directshape_torch.compilation.regions import Compilable
from directshape_torch.config_files import load_config
from directshape_torch.refiner import DirectShapeRefiner

# Two steps, so that the second one follows what the first has found.
FEW_STEPS = ("compile=on", "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 2}]")
FUNCTIONS = {"sample_grids", "probe_grids", "silhouette._of_grids", "photometric._of_grids"}

# Of the typical size of an output. Rounding takes a pixel over a threshold now and then, and with it what is summed
# over its block.
TOLERANCE, MAY_DIFFER = 1e-3, 0.05


@pytest.fixture(params=[1, 2])
def _threads(request: pytest.FixtureRequest) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(before)


@needs_compiler
@pytest.mark.usefixtures("_threads")
def test_compiled_functions_compute_what_they_compute_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: dict[str, list[float]] = {}
    compiled_form = Compilable.compiled

    def compare(function: Compilable[..., Any], *args: object, **kwargs: object) -> object:
        found = compiled_form(function, *args, **kwargs)
        if found is not None:
            with torch.no_grad():
                expected = function.plain(*args, **kwargs)
            pairs = zip(tree_leaves(found), tree_leaves(expected), strict=True)
            shares.setdefault(name_of(function), []).extend(share_that_differs(*pair) for pair in pairs)
        return found

    monkeypatch.setattr(Compilable, "compiled", compare)
    DirectShapeRefiner(config=load_config(None, FEW_STEPS))(*with_cars(demo_scene().frames, 5))
    assert shares.keys() == FUNCTIONS
    assert {name: max(of_outputs) for name, of_outputs in shares.items() if max(of_outputs) > MAY_DIFFER} == {}


def name_of(function: Compilable[..., Any]) -> str:
    module, name = function.plain.__module__.split(".")[-1], function.plain.__qualname__
    return f"{module}.{name}" if name == "_of_grids" else name


def share_that_differs(found: Tensor, expected: Tensor) -> float:
    """Of the elements of an output; NaN and infinities have to be the same."""
    assert found.shape == expected.shape
    assert found.dtype == expected.dtype
    found, expected = found.double(), expected.double()
    finite = expected[expected.isfinite()]
    atol = TOLERANCE * finite.abs().mean().item() if len(finite) else 0.0
    same = torch.isclose(found, expected, rtol=TOLERANCE, atol=atol, equal_nan=True)
    return 1.0 - same.double().mean().item()
