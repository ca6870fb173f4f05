"""Native loops are taken where they can be, tensor operations everywhere else."""

from __future__ import annotations

import importlib
import inspect
import logging
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor
from torch.autograd import forward_ad

from directshape_torch import kernels
from directshape_torch.kernels import choice, extents, iterations, jit, march, photometric, priors, shifts, silhouettes
from directshape_torch.kernels.choice import native_grid, without_kernels
from directshape_torch.shape.field import PackedField
from directshape_torch.shape.sdf_grid import GridShape

LOOPS = (
    *(march.march, silhouettes.silhouettes, photometric.photometric, priors.priors),
    *(iterations.propose, iterations.decide, shifts.shifted, extents.extents),
)


@pytest.fixture
def shape() -> GridShape:
    prior = ellipsoid_prior().float()
    return prior.bind(prior.initial_code(2))


@pytest.fixture
def bounds() -> Tensor:
    return ellipsoid_prior().float().bounds_obj


def is_taken(shape: object, *tensors: Tensor) -> bool:
    return native_grid(shape, *tensors) is not None


@torch.no_grad()
def test_single_precision_on_the_cpu_without_derivatives_is_native(shape: GridShape, bounds: Tensor) -> None:
    assert is_taken(shape, bounds, torch.ones(2))
    with without_kernels():
        assert not is_taken(shape, bounds, torch.ones(2))
    assert not is_taken(PackedField(shape), bounds)
    assert not is_taken(shape, bounds, torch.ones(2, dtype=torch.float64))
    assert not is_taken(shape, bounds.to("meta"))
    assert not is_taken(shape._replace(values=shape.values.double()), bounds)
    with torch.inference_mode():
        assert is_taken(shape, bounds)


def test_whatever_is_differentiated_takes_tensor_operations(shape: GridShape, bounds: Tensor) -> None:
    assert not is_taken(shape, bounds)
    taken = []

    def note(x: Tensor) -> Tensor:
        taken.append(is_taken(shape, bounds, x))
        return x

    with torch.no_grad():
        with forward_ad.dual_level():
            note(bounds)
        torch.func.vmap(note)(torch.ones(2, 3))
        torch.func.jvp(note, (torch.ones(2),), (torch.ones(2),))
        torch.compile(note, backend="eager")(torch.ones(2))
        assert is_taken(shape, bounds.clone().requires_grad_())
    assert taken == [False] * 4


@pytest.fixture
def _fresh_choice(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A process that has not used a loop yet."""
    for name in ("jit", "march", "photometric", "silhouettes"):
        monkeypatch.delitem(sys.modules, f"directshape_torch.kernels.{name}")
        monkeypatch.delattr(kernels, name)
    choice._is_installed.cache_clear()
    yield
    choice._is_installed.cache_clear()


@pytest.mark.usefixtures("_fresh_choice")
@pytest.mark.parametrize("is_installed", [False, True])
@torch.no_grad()
def test_one_line_says_how_much_slower_it_is_without_loops(
    shape: GridShape,
    bounds: Tensor,
    is_installed: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The cases are a package without Numba, and a Numba that may keep its code nowhere."""

    def njit(**_options: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    if is_installed:
        monkeypatch.setattr(numba, "njit", njit)
    else:
        monkeypatch.setitem(sys.modules, "numba", None)
    with caplog.at_level(logging.WARNING):
        assert not is_taken(shape, bounds)
        assert not is_taken(shape, bounds)
    (record,) = caplog.records
    assert "times as long" in record.getMessage()
    assert "directshape_torch[fast]" in record.getMessage()


@pytest.mark.parametrize("function", LOOPS)
def test_what_is_kept_on_the_disk_depends_on_all_sources(function: object) -> None:
    """Numba looks at the file of the loop alone, so the value of an argument stands for the others."""
    parameter = inspect.signature(function.py_func).parameters["_sources"]  # type: ignore[attr-defined]
    assert parameter.default == jit.SOURCES


def test_code_is_kept_where_the_folder_of_the_package_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file in the place of `__pycache__` stops the administrator, too."""
    module = tmp_path / "module"
    module.mkdir()
    (module / "__pycache__").write_text("")
    source = "from directshape_torch.kernels.jit import loop\n@loop\ndef twice(x):\n    return 2 * x\n"
    (module / "one_loop.py").write_text(source)
    monkeypatch.syspath_prepend(module)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")

    def imported_anew() -> tuple[bool, int]:
        """Whether code is kept, and how often it is taken, by a module that knows nothing of earlier imports."""
        monkeypatch.delitem(sys.modules, "one_loop", raising=False)
        twice = importlib.import_module("one_loop").twice
        is_kept = jit.is_compiled(twice)
        twice(1.0)
        return is_kept, sum(twice.stats.cache_hits.values())

    assert [imported_anew(), imported_anew()] == [(False, 0), (True, 1)]
    assert list((tmp_path / "cache").rglob("*.nbc"))
    # An earlier version of the package has left a list that names a type which this version lacks.
    (kept,) = (tmp_path / "cache").rglob("*.nbi")
    kept.write_bytes(pickle.dumps(numba.__version__) + b"cdirectshape_torch.kernels.arguments\nGone\n.")
    os.utime(kept, (0, 0))
    assert imported_anew() == (False, 0)
