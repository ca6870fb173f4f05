"""`compile: auto`: counts of cars decide when functions are compiled; the compiler itself is not needed for that."""

from __future__ import annotations

import pytest
import torch
from helpers.compiled_lookup import compile_nothing, nearest_inputs, without_disk

from directshape_torch.compilation import regions
from directshape_torch.compilation.regions import CARS_WORTH_COMPILING, CARS_WORTH_LOADING, cars_ahead, compiling


class TestAuto:
    """Counts of cars decide; the compiler itself is not needed for that."""

    @pytest.fixture(autouse=True)
    def _count(self, monkeypatch: pytest.MonkeyPatch) -> None:
        compile_nothing(monkeypatch)

    def test_where_nobody_knows_it_waits_until_the_cars_so_far_would_have_paid(self, nearest) -> None:
        for i in range(CARS_WORTH_COMPILING // 10 + 2):
            with compiling("auto", 10):
                nearest(*nearest_inputs(20, 10))
            assert nearest.num_variants == (10 * (i + 1) >= CARS_WORTH_COMPILING)

    def test_a_job_that_is_known_to_be_long_compiles_at_once(self, nearest) -> None:
        with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 10):
            nearest(*nearest_inputs(20, 10))
        assert nearest.num_variants == 1

    @pytest.mark.parametrize(("mode", "dtype"), [("off", torch.float32), ("auto", torch.float64)])
    def test_cars_that_compiling_would_not_have_helped_do_not_count(self, nearest, mode, dtype) -> None:
        points, grid, car = nearest_inputs(20, 10)
        with compiling(mode, 10 * CARS_WORTH_COMPILING):
            nearest(points.to(dtype), grid.to(dtype), car)
        assert regions._process.cars == 0
        with compiling("auto", 10):
            nearest(points, grid, car)
        assert nearest.num_variants == 0
        assert regions._process.cars == 10

    def test_a_job_that_is_known_to_be_short_never_compiles_whatever_came_before(self, nearest, monkeypatch) -> None:
        monkeypatch.setattr(regions._process, "cars", 10 * CARS_WORTH_COMPILING)
        with cars_ahead(50):
            for _ in range(5):
                with compiling("auto", 10):
                    nearest(*nearest_inputs(20, 10))
        assert nearest.num_variants == 0

    def test_the_end_of_a_long_job_does_not_compile(self, nearest) -> None:
        with cars_ahead(CARS_WORTH_COMPILING):
            with compiling("auto", CARS_WORTH_COMPILING - 20):
                pass
            with compiling("auto", 10):
                nearest(*nearest_inputs(20, 10))
        assert nearest.num_variants == 0

    def test_code_on_disk_is_loaded_for_far_fewer_cars(self, nearest, monkeypatch) -> None:
        without_disk(monkeypatch, stored=True)
        with compiling("auto", CARS_WORTH_LOADING - 1):
            nearest(*nearest_inputs(20, 10))
        assert nearest.num_variants == 0
        with compiling("auto", 1):
            nearest(*nearest_inputs(20, 10))
        assert nearest.num_variants == 1
        assert CARS_WORTH_LOADING < CARS_WORTH_COMPILING / 4

    def test_what_is_compiled_is_used_for_a_single_car(self, nearest) -> None:
        with compiling("on", 3):
            nearest(*nearest_inputs(20, 3))
        calls = []
        (form,) = next(iter(nearest._forms.values()))
        form.function = lambda *values: calls.append(values)
        with compiling("auto", 1):
            nearest(*nearest_inputs(20, 3))
        assert len(calls) == 1
