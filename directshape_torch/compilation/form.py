"""A function of tensors compiled for one variant of its arguments, as an object that can be kept on disk whole.

By itself `torch.compile` finds the code that an earlier process generated only after tracing the function anew, which
is half of a warm start. Compiled ahead of its first call, a function is stored with all that tracing found.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from directshape_torch.compilation.inputs import constants_of, global_settings, with_varying_sizes

if TYPE_CHECKING:
    from torch._dynamo.aot_compile import AOTCompiledFunction
    from torch._dynamo.types import GuardFilterEntry

# Indices are right by construction (NaN included); sizes are checked before a call. Both checks cost a multiple of the
# arithmetic. Code that asks for the number of threads serves every setting of the user with one entry on disk. What the
# processor says of its vector units is believed: trying each of them with the compiler takes seconds of the first start
# and one of later ones, and a compiler that reads PyTorch's headers at all (C++20) knows them. Precompiled
# headers would cost a first start what they save it. No operation writes over its operand: PyTorch 2.13 lets one
# write over a part of a `torch.stack` too, and then gives the whole stack to another while what was written is read.
_OPTIONS: dict[str, str | int | bool | Callable[..., Any]] = {
    "inplace_buffers": False,
    "assert_indirect_indexing": False,
    "size_asserts": False,
    "cpp.dynamic_threads": True,
    "cpp.vec_isa_ok": True,
    "cpp_cache_precompile_headers": False,
}


class CompiledForm:
    """What one compilation made of a function."""

    def __init__(self, function: AOTCompiledFunction) -> None:
        self._function = function

    @classmethod
    def of(
        cls, function: Callable[..., Any], values: Sequence[object], varying: Sequence[tuple[int, ...]]
    ) -> CompiledForm:
        """Compile a function for arguments like these, of which some dimensions vary from call to call.

        Raises:
            Exception: of any kind that PyTorch's compiler raises.
        """
        with _quiet():
            import torch._dynamo
            import torch._inductor.config
        with (
            _quiet(),
            torch.no_grad(),
            # Sizes that do not vary are constants, whatever was compiled before. Shapes that depend on sizes are not
            # worth remembering: asking costs more than finding them again.
            torch._dynamo.config.patch(automatic_dynamic_shapes=False, fake_tensor_cache_enabled=False),
            # The whole is put together from what the cache holds; whether it is kept is for the store to decide.
            torch._inductor.config.patch(force_disable_caches=False),
        ):
            lazy = torch.compile(function, fullgraph=True, options={**_OPTIONS, "guard_filter_fn": _of_arguments})
            return cls(lazy.aot_compile((with_varying_sizes(values, varying), {})))  # type: ignore[attr-defined]

    @classmethod
    def from_bytes(cls, data: bytes) -> CompiledForm:
        """What `to_bytes` gave, in a process of the same versions.

        Raises:
            Exception: of any kind, where the bytes are damaged or of other versions.
        """
        with _quiet():
            import torch._inductor.config
            from torch._dynamo.aot_compile import AOTCompiledFunction

            # The libraries that belong to it are looked up by the very command that compiled them.
            with torch._inductor.config.patch(_OPTIONS):
                return cls(AOTCompiledFunction.deserialize(data))

    def to_bytes(self) -> bytes:
        """For a file: generated code, and what was traced. It is unpickled, so only for a folder of one's own."""
        return type(self._function).serialize(self._function).serialized_data

    def fits(self, values: Sequence[object]) -> bool:
        """Whether it holds for these arguments: all that tracing has assumed of the tensors that it reads is checked.

        Types, dtypes, devices, sizes, memory layout and gradients; not the settings of PyTorch (`global_settings`).
        """
        return self._function.guard_check(*values)

    def __call__(self, values: Sequence[object]) -> Any:
        return self._function.fn(*values)


class LatestForm(NamedTuple):
    """The form that a function's latest call took: most calls are like the one before.

    What a form checks of the tensors that it reads is all that their variant and their kind would say, and takes less
    time than those.
    """

    form: CompiledForm
    forms: Mapping[tuple[object, ...], Sequence[CompiledForm]]  # of which it is one
    settings: tuple[object, ...]
    constants: list[object]

    @classmethod
    def of(
        cls,
        form: CompiledForm,
        forms: Mapping[tuple[object, ...], Sequence[CompiledForm]],
        values: Sequence[object],
    ) -> LatestForm:
        """For a form of a function that was called with these arguments."""
        return cls(form, forms, global_settings(), constants_of(values))

    def fits(self, values: Sequence[object]) -> bool:
        """Whether it holds for these arguments, under the present settings."""
        same = self.constants == constants_of(values) and self.settings == global_settings()
        return same and self.form.fits(values)


def _of_arguments(guards: Sequence[GuardFilterEntry]) -> list[bool]:
    """Which of the things that tracing has assumed are to be checked: what concerns arguments, and can be stored.

    Settings of PyTorch make variants of their own (`global_settings`), and the number of threads is no matter. Names of
    modules are taken for constants.
    """
    from torch._dynamo.guards import CheckFunctionManager

    not_stored = CheckFunctionManager.UNSUPPORTED_SERIALIZATION_GUARD_TYPES
    of_arguments = (not g.is_global and (g.name != "" or g.guard_type == "SHAPE_ENV") for g in guards)
    return [mine and g.guard_type not in not_stored for mine, g in zip(of_arguments, guards, strict=True)]


def code_settings() -> str:
    """What decides which code a function becomes, beside its arguments: versions, processor, PyTorch's settings."""
    with _quiet():
        import torch._inductor.config
        from torch._dynamo.package import SystemInfo
        from torch._inductor.cpu_vec_isa import pick_vec_isa

        with torch._inductor.config.patch(_OPTIONS):
            of_compiler = sorted(torch._inductor.config.save_config_portable().items(), key=str)
            return repr((SystemInfo.current(), str(pick_vec_isa()), of_compiler))


@contextmanager
def _quiet() -> Iterator[None]:
    # PyTorch's own deprecations, where its caller has made errors of warnings, are no reason not to compile.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
