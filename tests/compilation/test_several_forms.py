"""Forms that hold for some arguments only: several of a variant, and arguments that none will ever hold for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from helpers.compiled_lookup import PlainForm, compile_nothing, needs_compiler
from torch import Tensor

from directshape_torch.compilation import compilable as compilable_module
from directshape_torch.compilation import regions
from directshape_torch.compilation.compilable import Compilable, compilable
from directshape_torch.compilation.regions import (
    CARS_WORTH_COMPILING,
    CARS_WORTH_LOADING,
    cars_ahead,
    compiling,
)
from directshape_torch.compilation.request import CompileRequest
from directshape_torch.compilation.together import compiled_together
from directshape_torch.errors import CompilationError


def added(x: Tensor, y: Tensor) -> Tensor:
    return x + y


class EvenForm(PlainForm):
    """Holds for arguments of even length, or for those of odd length."""

    def __init__(self, function: Callable[..., object], parity: int) -> None:
        super().__init__(function)
        self.parity = parity

    def fits(self, values: Sequence[object]) -> bool:
        assert isinstance(values[0], Tensor)
        return len(values[0]) % 2 == self.parity


@pytest.fixture
def function() -> Compilable[[Tensor, Tensor], Tensor]:
    return compilable(sizes={"x": 0, "y": 0})(added)


class TestForms:
    @pytest.fixture(autouse=True)
    def _parities(self, monkeypatch: pytest.MonkeyPatch) -> None:
        compile_nothing(monkeypatch)
        monkeypatch.setattr(
            CompileRequest, "compile", lambda self, function: EvenForm(function, self.arguments[0].shape[0] % 2)
        )

    def test_a_variant_has_as_many_forms_as_its_arguments_need(self, function) -> None:
        for length in (2, 4, 3, 6, 5):
            with compiling("on", 1):
                assert torch.equal(function(torch.ones(length), torch.ones(length)), torch.full((length,), 2.0))
        (forms,) = function._forms.values()
        assert [form.parity for form in forms] == [0, 1]

    def test_stored_forms_are_loaded_until_one_holds(self, function, monkeypatch) -> None:
        asked = []

        def load(plain: Callable[..., object], _: object, number: int) -> EvenForm | None:
            asked.append(number)
            return EvenForm(plain, number) if number < 2 else None

        monkeypatch.setattr(compilable_module, "load", load)
        with cars_ahead(CARS_WORTH_LOADING), compiling("auto", 1):
            for length in (3, 2, 5):
                function(torch.ones(length), torch.ones(length))
        assert asked == [0, 1]

    def test_the_disk_is_asked_once_where_nothing_is_compiled(self, function, monkeypatch) -> None:
        asked = []
        monkeypatch.setattr(compilable_module, "load", lambda *arguments: asked.append(arguments))
        with cars_ahead(CARS_WORTH_COMPILING - 1), compiling("auto", 1):
            for _ in range(3):
                function(torch.ones(2), torch.ones(2))
        assert len(asked) == 1

    @pytest.mark.parametrize("run", [compiled_together, lambda work: work()])
    def test_arguments_that_no_form_holds_for_end_as_a_failure(self, function, run, monkeypatch, caplog) -> None:
        monkeypatch.setattr(EvenForm, "fits", lambda *_: False)
        x = torch.ones(2)
        for _ in range(20):
            with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 1):
                assert torch.equal(run(lambda: function(x, x)), 2 * x)
        assert caplog.text.count("forms were compiled for arguments that hardly differ") == 1
        with compiling("on", 1), pytest.raises(CompilationError, match="hardly differ"):
            run(lambda: function(x, x))


@needs_compiler
def test_a_tensor_that_is_two_arguments_needs_no_form_of_its_own(function) -> None:
    x = torch.rand(6)
    with compiling("on", 1):
        for _ in range(2):
            assert torch.equal(compiled_together(lambda: function(x, x)), x + x)
        assert torch.equal(function(x, x + 1), x + (x + 1))
    assert [len(forms) for forms in function._forms.values()] == [1]


@needs_compiler
def test_a_side_of_length_one_may_have_any_stride_in_what_counts_as_contiguous() -> None:
    doubled = compilable(sizes={"x": 0})(lambda x: 2 * x)
    x = torch.rand(1, 4, 6).movedim(0, -1)
    assert x.is_contiguous()
    assert x.stride() != torch.rand(4, 6, 1).stride()
    with compiling("on", 1):
        for _ in range(2):
            assert torch.equal(compiled_together(lambda: doubled(x)), x + x)
            assert torch.equal(doubled(x + 0), x + x)
    assert 1 <= len(next(iter(doubled._forms.values()))) <= 2


def test_rays_that_might_be_compiled_count_even_where_they_are_not(function) -> None:
    with compiling("auto", 7):
        assert not function.may_be_compiled(torch.ones(3, dtype=torch.float64))
    assert regions._process.cars == 0
    with compiling("auto", 7):
        assert not function.may_be_compiled(torch.ones(3))
    assert regions._process.cars == 7
    assert not function.may_be_compiled(torch.ones(3))
