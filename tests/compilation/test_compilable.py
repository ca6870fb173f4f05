"""Which calls are compiled and how often, and which take the plain form."""

from __future__ import annotations

import threading

import pytest
import torch
from helpers.compiled_lookup import (
    Nearest,
    nearest_inputs,
    nearest_values,
    needs_compiler,
)
from torch import Tensor
from torch._dynamo.utils import counters
from torch.utils._python_dispatch import TorchDispatchMode

from directshape_torch.compilation.compilable import compilable
from directshape_torch.compilation.form import LatestForm
from directshape_torch.compilation.machine import compiler_problem
from directshape_torch.compilation.regions import compiling

pytestmark = pytest.mark.usefixtures("fresh_compiler_counts")


@needs_compiler
def test_one_compilation_serves_all_sizes_and_gives_the_plain_values(nearest) -> None:
    # The sizes of the first call are equal by accident; nothing may follow from that.
    for num_points, num_cars in [(3, 3), (5, 3), (130, 2), (2, 7), (64, 64), (1000, 9)]:
        inputs = nearest_inputs(num_points, num_cars)
        with compiling("on", num_cars):
            values = nearest(*inputs)
        for value, expected in zip(values, nearest_values(*inputs), strict=True):
            torch.testing.assert_close(value, expected)
    assert nearest.num_variants == 1
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_sizes_0_and_1_are_plain_and_cost_no_compilation(nearest) -> None:
    with compiling("on", 1):
        for num_points, num_cars in [(0, 2), (1, 2), (5, 1)]:
            inputs = nearest_inputs(num_points, num_cars)
            for value, expected in zip(nearest(*inputs), nearest_values(*inputs), strict=True):
                assert torch.equal(value, expected)
    assert nearest.num_variants == counters["stats"]["unique_graphs"] == 0


@needs_compiler
def test_layout_parameters_keywords_and_gradient_mode_make_no_further_variant(nearest) -> None:
    points, grid, car = nearest_inputs(40, 3)
    other_layout = points.T.contiguous().T
    parameter = torch.nn.Parameter(grid)
    with compiling("on", 3):
        first = nearest(points, grid, car)
        with torch.no_grad():
            again = [nearest(other_layout, grid, car), nearest(points, parameter, car=car), nearest(points, grid, car)]
    for values in again:
        assert torch.equal(values[0], first[0])
    assert counters["stats"]["unique_graphs"] == 1


def scaled(x: Tensor, by: float, offsets: Tensor) -> Tensor:
    return x * by + offsets.sum()


@needs_compiler
def test_what_the_latest_call_took_is_taken_again_for_the_like_alone() -> None:
    """The shortcut asks what the long way asks: constants, settings, kinds of tensors, and what may be compiled."""
    function = compilable(sizes={"x": 0, "offsets": 0})(scaled)
    x, none = torch.ones(4, 3), torch.zeros(5)
    with compiling("on", 1):
        assert function(x, 2.0, none).tolist() == [[2.0] * 3] * 4
        assert function(x[:2], by=2.0, offsets=none).tolist() == [[2.0] * 3] * 2
        assert function.num_variants == 1
        assert function(x, 3.0, none).tolist() == [[3.0] * 3] * 4
        assert function.num_variants == 2
        assert function(x, 2.0, none).tolist() == [[2.0] * 3] * 4
        assert function.num_variants == 2
        assert function(torch.ones(2, 4), 2.0, none).shape == (2, 4)
        assert function.num_variants == 3
        before = counters["stats"]["unique_graphs"]
        # Plain, each for a reason of its own.
        assert function(torch.ones(1, 4), 2.0, none).shape == (1, 4)
        assert function(torch.ones(2, 4).double(), 2.0, none).dtype == torch.float64
        assert function(torch.ones(2, 4, requires_grad=True), 2.0, none).requires_grad
        with torch.autocast("cpu"):
            assert function(torch.ones(2, 4), 2.0, none).shape == (2, 4)
    assert function(torch.ones(2, 4), 2.0, none).shape == (2, 4)
    assert counters["stats"]["unique_graphs"] == before


@needs_compiler
def test_a_form_that_another_thread_takes_meanwhile_is_not_the_one_that_was_checked(monkeypatch) -> None:
    function = compilable(sizes={"x": 0, "offsets": 0})(scaled)
    x, none = torch.ones(4, 3), torch.zeros(5)
    with compiling("on", 1):
        function(x, 3.0, none)
        other = function._latest
        function(x, 2.0, none)
        fits = LatestForm.fits

        def and_then_comes_another(latest: LatestForm, values: tuple[object, ...]) -> bool:
            found = fits(latest, values)
            function._latest = other
            return found

        monkeypatch.setattr(LatestForm, "fits", and_then_comes_another)
        assert function(x, 2.0, none).tolist() == [[2.0] * 3] * 4


@needs_compiler
def test_inference_mode_makes_no_further_variant(nearest) -> None:
    expected = nearest_values(*nearest_inputs(40, 3))[0]
    with compiling("on", 3):
        nearest(*nearest_inputs(40, 3))
    with torch.inference_mode():
        points, grid, car = nearest_inputs(40, 3)
        assert points.is_inference()
        with compiling("on", 3):
            values = [nearest(points, grid, car)[0], nearest(points + 0, grid, car + 0)[0]]
            assert not torch.is_grad_enabled()
        assert torch.is_inference_mode_enabled()
    for value in values:
        torch.testing.assert_close(value, expected)
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_it_is_repeatable_to_the_bit(nearest) -> None:
    inputs = nearest_inputs(1000, 3)
    with compiling("on", 3):
        first, second = nearest(*inputs), nearest(*inputs)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


@needs_compiler
def test_the_number_of_threads_is_left_alone_and_any_number_gives_the_values(nearest) -> None:
    inputs = nearest_inputs(5000, 3)
    with compiling("on", 3):
        one_thread = nearest(*inputs)
        assert torch.get_num_threads() == 1
        torch.set_num_threads(2)
        try:
            two_threads = nearest(*inputs)
            assert torch.get_num_threads() == 2
        finally:
            torch.set_num_threads(1)
    assert torch.equal(one_thread[0], two_threads[0])


@needs_compiler
def test_threads_that_call_at_once_share_one_compilation(nearest) -> None:
    inputs = nearest_inputs(100, 3)
    results: list[Tensor] = []

    def call() -> None:
        with compiling("on", 3):
            results.append(nearest(*inputs)[0])

    threads = [threading.Thread(target=call) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    assert all(torch.equal(result, results[0]) for result in results)
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_another_fixed_size_is_another_variant(nearest) -> None:
    points, grid, car = nearest_inputs(10, 3)
    with compiling("on", 3):
        nearest(points, grid, car)
        nearest(points, torch.rand(3, 5, 4), car)
    assert nearest.num_variants == 2


@pytest.mark.parametrize("mode", ["off", "auto"])
def test_off_and_a_few_cars_stay_plain(nearest, mode) -> None:
    with compiling(mode, 7):
        nearest(*nearest_inputs(100, 7))
    assert nearest.num_variants == 0


def test_outside_a_region_it_is_plain(nearest) -> None:
    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3):
        pass
    nearest(*nearest_inputs(100, 7))
    assert nearest.num_variants == 0


def test_gradients_double_precision_transforms_and_autocast_stay_plain(nearest) -> None:
    points, grid, car = nearest_inputs(10, 3)
    attached = points.clone().requires_grad_()
    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3):
        nearest(attached, grid, car)[0].sum().backward()
        assert attached.grad is not None
        assert nearest(points.double(), grid.double(), car)[0].dtype == torch.float64
        jacobian = torch.func.jacfwd(lambda x: nearest(x, grid, car)[0])(points)
        assert jacobian.shape == (10, 10, 2)
        with torch.autograd.forward_ad.dual_level():
            dual = torch.autograd.forward_ad.make_dual(points, torch.ones_like(points))
            tangent = torch.autograd.forward_ad.unpack_dual(nearest(dual, grid, car)[0]).tangent
        assert torch.equal(tangent, torch.full((10,), 2.0))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            nearest(points, grid, car)
    assert nearest.num_variants == 0


@needs_compiler
def test_the_users_own_compilation_sees_the_plain_function(nearest) -> None:
    points, grid, car = nearest_inputs(10, 3)
    theirs = torch.compile(lambda x: nearest(x, grid, car)[0] * 2, fullgraph=True, backend="aot_eager")
    with compiling("on", 3):
        assert torch.equal(theirs(points), 2 * nearest_values(points, grid, car)[0])
    assert nearest.num_variants == 0


def test_a_mode_that_watches_every_function_sees_the_plain_one(nearest) -> None:
    seen = []

    class Watching(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, function, types, args=(), kwargs=None):
            seen.append(function)
            return function(*args, **(kwargs or {}))

    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3), Watching():
        nearest(*nearest_inputs(40, 3))
    assert torch.fmin in seen
    assert nearest.num_variants == 0


def test_a_mode_that_watches_every_operation_sees_the_plain_one(nearest: Nearest) -> None:
    """As `FlopCounterMode` does: the compiler refuses to trace under one."""
    seen = []

    class Watching(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            seen.append(function.overloadpacket)
            return function(*args, **(kwargs or {}))

    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3), Watching():
        nearest(*nearest_inputs(40, 3))
    assert torch.ops.aten.fmin in seen
    assert nearest.num_variants == 0
