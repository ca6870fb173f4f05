"""Every compiled function agrees with its plain form, on all calls of a refinement.

The compiler's use of memory depends on the whole function and on its sizes, so only real functions with real arguments
show whether their code is right.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pytest
import torch
from benchmark_suites.workloads import demo_scene
from helpers.car_counts import with_cars
from helpers.compiled_lookup import graphs, needs_compiler
from torch import Tensor
from torch.utils._pytree import tree_leaves

from directshape_torch.compile import Compilable, compiler_problem
from directshape_torch.io.config_files import load_config
from directshape_torch.refiner import DirectShapeRefiner

# Two iterations, so that the second one follows what the first has found.
FEW_STEPS = (
    "compile=on",
    "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 2}, {max_iterations: 2}]",
)

# For each output the axes of its components, which are quantities of their own.
SUMS: list[tuple[int, ...]] = [(), (1, 2), (1, 2), (1, 2)]  # cost, products, information, residual of a term
COMPONENT_AXES: dict[str, list[tuple[int, ...]]] = {
    "marched_views": [(0,), (), (), (0,), (0,), (0,), (), ()],
    "parts_of": [*SUMS[:3], (2,), (0,), (), (), (0,), *SUMS[:3], (2,), (0,), (0,), (), (), (), *(4 * SUMS)],
    "shifted_costs": [(0, 1)],
}

# Of the mean size of a component, and metres or whatever its unit is. Rounding takes a pixel over a threshold now and
# then, or over a line of pixel centres, where the slope of the image jumps, and with it what is summed over its block:
# a state moved by a unit in its last place changes that as much. Which ends of a bracket are kept is a matter of
# rounding for every fifth ray that has converged. An error of the compiler concerns all of a component, or nearly.
TOLERANCE, FLOOR = 1e-3, 1e-4
MAY_DIFFER, FLAGS_MAY_DIFFER = 0.4, 0.005


@pytest.fixture
def _two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@needs_compiler
@pytest.mark.usefixtures("_two_threads", "fresh_compiler_counts")
def test_compiled_functions_compute_what_they_compute_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is compiled once for all numbers of cars and pixels; of a rig without an offset the terms are another."""
    wrong: dict[str, set[str]] = {}
    run_compiled = Compilable._run

    def compare(function: Compilable[..., Any], values: Sequence[Any]) -> object:
        found = run_compiled(function, values)
        with torch.no_grad():
            expected = function.plain(*values)
        name = function.plain.__name__
        wrong.setdefault(name, set()).update(differences(name, found, expected))
        return found

    assert compiler_problem() is None
    traced = graphs()  # of that question
    monkeypatch.setattr(Compilable, "_run", compare)
    for number_of_forms, num_cars, max_pixels, sigma_px in ((3, 5, 900, 0.5), (3, 3, 450, 0.5), (4, 40, 900, 0)):
        changes = f"rig.disparity_sigma_px={sigma_px}", f"sampling.max_pixels={max_pixels}"
        refiner = DirectShapeRefiner(config=load_config(None, [*FEW_STEPS, *changes]))
        refiner(*with_cars(demo_scene().frames, num_cars))
        assert wrong == {name: set() for name in COMPONENT_AXES}
        assert graphs() - traced == number_of_forms


def differences(name: str, found: object, expected: object) -> Iterator[str]:
    """The components of all outputs that are not the same."""
    leaves = tree_leaves(found), tree_leaves(expected)
    # Where the rig's disparity may be off it has a prior, which comes last.
    axes_of_outputs = [*COMPONENT_AXES[name], *SUMS][: len(leaves[0])]
    outputs = zip(axes_of_outputs, *leaves, strict=True)
    for number, (axes, mine, theirs) in enumerate(outputs):
        assert mine.shape == theirs.shape
        assert mine.dtype == theirs.dtype
        shares = share_that_differs(by_component(mine, axes), by_component(theirs, axes))
        allowed = FLAGS_MAY_DIFFER if mine.dtype == torch.bool else MAY_DIFFER
        places = (shares > allowed).nonzero()[:, 0].tolist()
        yield from (f"output {number}, component {place}: {shares[place]:.0%} differ" for place in places)


def by_component(output: Tensor, axes: tuple[int, ...]) -> Tensor:
    """Values (components, elements of each) in double precision."""
    count = torch.Size([output.shape[axis] for axis in axes]).numel()
    return output.movedim(axes, tuple(range(len(axes)))).reshape(count, -1).double()


def share_that_differs(found: Tensor, expected: Tensor) -> Tensor:
    """Share of differing elements in each component; values that are not finite must be the same."""
    finite = expected.isfinite()
    size = torch.where(finite, expected, 0.0).abs().sum(dim=1) / finite.sum(dim=1).clamp_min(1)
    near = (found - expected).abs() <= TOLERANCE * (size[:, None] + expected.abs()) + FLOOR
    same = near | (found == expected) | (found.isnan() & expected.isnan())
    return 1 - same.double().mean(dim=1)


def test_what_is_wrong_is_seen_component_by_component() -> None:
    flags, depth = torch.rand(75, 64) < 0.5, torch.rand(75, 64)
    points, faces = torch.randn(2, 3, 75, 64, generator=torch.Generator().manual_seed(0)).unbind(0)
    right = points, depth, flags, faces, points, faces, flags, depth
    assert list(differences("marched_views", right, right)) == []
    overwritten = points.clone()
    overwritten[2] = overwritten[0]
    assert len(list(differences("marched_views", (overwritten, *right[1:]), right))) == 1
    assert len(list(differences("marched_views", (*right[:7], depth * torch.nan), right))) == 1
    assert len(list(differences("marched_views", (*right[:2], ~flags, *right[3:]), right))) == 1
