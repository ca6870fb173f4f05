"""What must be known to compile a function, here or in another process: its name, and arguments without values."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from directshape_torch.compilation.form import CompiledForm
from directshape_torch.compilation.inputs import global_settings
from directshape_torch.compilation.store import store


@dataclass(frozen=True)
class _TensorLike:
    shape: tuple[int, ...]
    stride: tuple[int, ...]
    dtype: torch.dtype
    device: torch.device

    def tensor(self) -> Tensor:
        return torch.empty_strided(self.shape, self.stride, dtype=self.dtype, device=self.device)


@dataclass(frozen=True)
class CompileRequest:
    """A function to compile for one variant of its arguments.

    Attributes:
        module, name: where the marked function is found.
        variant: what its arguments have in common, as `variant_of` gives it, without the number of threads.
        number: of the form, where the variant has several.
        arguments: constants, and what tensors are like.
        varying: for each argument the dimensions whose sizes vary.
    """

    module: str
    name: str
    variant: tuple[object, ...]
    number: int
    arguments: tuple[object, ...]
    varying: tuple[tuple[int, ...], ...]

    @classmethod
    def of(
        cls,
        function: Callable[..., Any],
        variant: tuple[object, ...],
        number: int,
        values: Sequence[object],
        varying: Sequence[tuple[int, ...]],
    ) -> CompileRequest:
        """For a plain function and arguments that it was called with.

        Example:
            >>> from directshape_torch.table_lookup import take
            >>> request = CompileRequest.of(take, (), 0, (torch.ones(5), torch.arange(2)), ((0,), (0,)))
            >>> request.name, request.is_for_helpers()
            ('take', False)
        """
        arguments = tuple(
            _TensorLike(tuple(v.shape), v.stride(), v.dtype, v.device) if isinstance(v, Tensor) else v for v in values
        )
        return cls(function.__module__, function.__qualname__, variant, number, arguments, tuple(varying))

    def is_for_helpers(self) -> bool:
        """Whether another process would find the function, and needs no graphics card for it."""
        on_processor = all(a.device.type == "cpu" for a in self.arguments if isinstance(a, _TensorLike))
        return on_processor and self.module != "__main__" and self._found() is not None

    def compile(self, function: Callable[..., Any]) -> CompiledForm:
        """The form of the plain function.

        Raises:
            Exception: of any kind that PyTorch's compiler raises.
        """
        values = [a.tensor() if isinstance(a, _TensorLike) else a for a in self.arguments]
        return CompiledForm.of(function, values, self.varying)

    def compile_elsewhere(self) -> None:
        """`compile` in a process that was started for it, into the store.

        Raises:
            RuntimeError: the function is not here, or settings of PyTorch differ from those it was asked with.
            Exception: of any kind that PyTorch's compiler raises.
        """
        function, settings = self._found(), global_settings()[1:]
        if function is None or self.variant[: len(settings)] != settings:
            raise RuntimeError(f"{self.name} cannot be compiled in this process: other code, or other settings")
        store(self.compile(function), function, self.variant, self.number)

    def _found(self) -> Callable[..., Any] | None:
        """The plain function, if it is where its name says."""
        try:
            marked = functools.reduce(getattr, self.name.split("."), importlib.import_module(self.module))
        except (ImportError, AttributeError):
            return None
        plain: Callable[..., Any] | None = getattr(marked, "plain", None)
        return plain
