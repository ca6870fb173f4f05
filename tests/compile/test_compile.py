"""Compiled functions compute what they compute plainly, take their plain form where they must, and need a compiler."""

from __future__ import annotations

import os
import shutil
from inspect import signature

import pytest
import torch
from benchmark_suites.workloads import demo_scene
from helpers.car_counts import with_cars
from torch import Tensor

from directshape_torch.compile import check_compiler, compilable, compiling
from directshape_torch.errors import CompilationError
from directshape_torch.io.config_files import load_config
from directshape_torch.kernels.choice import without_kernels
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.terms.priors import PriorTerm
from directshape_torch.terms.term import AnyTerm, parts_of

CPU = torch.device("cpu")


@pytest.mark.skipif(shutil.which(os.environ.get("CXX", "g++")) is None, reason="no C++ compiler on the PATH")
@pytest.mark.skipif("recompile_limit" not in signature(torch.compile).parameters, reason="PyTorch is older than 2.13")
@pytest.mark.parametrize("name", ["prior", pytest.param("photometric", marks=pytest.mark.long)])
@torch.no_grad()
def test_a_term_of_five_cars_has_its_plain_values(name: str) -> None:
    from torch._dynamo.utils import counters

    problem, state = DirectShapeRefiner(config=load_config()).problem(*with_cars(demo_scene().frames, 5))
    state = state.unknowns.retract(state, torch.full((5, state.unknowns.size), 0.02))
    with without_kernels():
        prepared = problem.prepare(state)
        stage = problem.begin(0, prepared)
        prior = next(term for term in stage.terms if isinstance(term, PriorTerm))
        term: AnyTerm | None = stage.photometric if name == "photometric" else prior
        assert term is not None
        inputs = (term,), prepared.field, state, (term.anchor(prepared),)
        (plain,), before = parts_of(*inputs), counters["stats"]["unique_graphs"]
        with compiling("on", CPU):
            (compiled,) = parts_of(*inputs)
    assert counters["stats"]["unique_graphs"] > before
    for found, expected in zip(compiled[:4], plain[:4], strict=True):
        assert expected.abs().max() > 0
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


class TestForms:
    """A stand-in for the compiler tells which form a function takes."""

    @pytest.fixture(autouse=True)
    def _stand_in(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(torch, "compile", lambda function, **_: lambda x: function(x) + 1)

    @staticmethod
    @compilable
    def doubled(x: Tensor) -> Tensor:
        return 2 * x

    def test_a_region_is_compiled_where_it_is_on(self) -> None:
        with torch.no_grad():
            with compiling("on", CPU):
                assert self.doubled(torch.ones(1)) == 3
                with compiling("off", CPU):
                    assert self.doubled(torch.ones(1)) == 2
                assert self.doubled(torch.ones(1)) == 3
            assert self.doubled(torch.ones(1)) == 2

    def test_what_is_differentiated_is_plain(self) -> None:
        one = torch.ones(1)
        with compiling("on", CPU):
            (gradient,) = torch.autograd.grad(self.doubled(leaf := one.clone().requires_grad_()), leaf)
            value, slope = torch.func.jvp(self.doubled, (one,), (one,))
            with torch.no_grad():
                _, inside = torch.func.jvp(self.doubled, (one,), (one,))
        assert gradient == value == slope == inside == 2


@torch.no_grad()
def test_the_users_own_compilation_sees_the_plain_function() -> None:
    theirs = torch.compile(lambda x: TestForms.doubled(x) + 1, backend="eager", fullgraph=True)
    with compiling("on", CPU):
        assert theirs(torch.ones(1)) == 3


def test_without_a_compiler_on_is_refused_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("\nno C++ compiler was found\nmore")

    refiner = DirectShapeRefiner(config=load_config(None, ["compile=on"]))
    monkeypatch.setattr(torch, "compile", fails)
    monkeypatch.setattr(refiner, "_refine", fails)
    check_compiler.cache_clear()
    for _ in range(2):
        with pytest.raises(
            CompilationError,
            match=r"2\.13 or later and .* works on cpu, but no C\+\+ compiler was found; set compile to off$",
        ):
            refiner(*with_cars(demo_scene().frames, 1))
