"""This module simulates a device that keeps its tensors apart, like a graphics card, in the memory of the CPU.

`torch.device("card")` has every operation that PyTorch has on a CPU, computed there, so results are equal to the bit.
But tensors of both devices cannot be mixed, numbers are copied only where the program says so, and each wait of the
host for the device is noted, as far as the names of operations reveal it. The device is stricter than a real card with
indices on the CPU. It does not show properties of a real card such as other kernels, other orders of
sums and memory.

The device belongs to the process that imports this module, so tests use it in a separate process (`card_cases`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

from directshape_torch.numerics import gradient_mode


class _Module(backend_registration._DummyBackendModule):
    """A `_Module` is `torch.card`, with the functions that PyTorch calls on any device."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.float16]


backend_registration._setup_privateuseone_for_python_backend("card", _Module())
CARD = torch.device("card:0")

# On a card tensors of a single number from the processor go with operations element by element, and with no others.
_NO_SINGLE_NUMBERS = {"aten.cat", "aten.stack"}
# Their results, or the shapes of their results, are read by the host.
WAITS = {
    "aten._local_scalar_dense",
    "aten.is_nonzero",
    "aten.equal",
    "aten.nonzero",
    "aten.masked_select",
    "aten.bincount",
    "aten._unique",
    "aten._unique2",
    "aten.unique_dim",
    "aten.unique_consecutive",
    "aten.unique_dim_consecutive",
    # Whether a decomposition has failed; `cholesky_ex` and its like leave the question to the caller.
    "aten._linalg_check_errors",
    "aten._linalg_eigh",
    "aten.linalg_lstsq",
}
# By a mask they ask how many places it has.
INDEXED = {"aten.index", "aten.index_put", "aten.index_put_", "aten._index_put_impl_"}


_waits: list[str] = []


@contextmanager
def noted_waits() -> Iterator[list[str]]:
    """The operations in the body for which the host waited, in order."""
    _waits.clear()
    found: list[str] = []
    try:
        yield found
    finally:
        found += _waits


class CardTensor(torch.Tensor):
    """A `CardTensor` is a tensor that claims to be on the card."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, held: Tensor) -> CardTensor:
        made: CardTensor = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            layout=held.layout,
            device=CARD,
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _run(func, *args, **(kwargs or {}))

    # PyTorch's own versions are for `torch.Tensor` alone.
    def tolist(self) -> Any:
        _waits.append("tolist")
        return self.held.tolist()

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"on the card: {self.held!r}"

    def __format__(self, spec: str) -> str:
        return format(self.item() if self.dim() == 0 else repr(self), spec)


def _run(func: Any, *args: Any, **kwargs: Any) -> Any:
    """Run an operation that has a tensor of the card, or makes one."""
    name = str(func.overloadpacket)
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    on_card = [x for x in tensors if isinstance(x, CardTensor)]
    elsewhere = [x for x in tensors if not isinstance(x, CardTensor)]
    device = kwargs.get("device")
    if on_card and not _may_mix(func, args, elsewhere):
        raise RuntimeError(f"{name}: expected all tensors on one device, {[tuple(x.shape) for x in elsewhere]} are not")
    if not on_card and device is None:
        raise RuntimeError(f"{name}: neither a tensor of the card nor its name")
    unsized = name == "aten.repeat_interleave" and kwargs.get("output_size") is None
    leaves = name == "aten._to_copy" and device is not None and torch.device(device).type == "cpu"
    arrives = name == "aten._to_copy" and not on_card
    if leaves or arrives or unsized or name in WAITS or (name == "aten.copy_" and elsewhere) or _is_by_mask(name, args):
        _waits.append(name)
    if device is not None:
        kwargs["device"] = torch.device("cpu")
    result = func(*tree_map(_held, args), **tree_map(_held, kwargs))
    if any(x.shape != x.held.shape for x in on_card):
        raise NotImplementedError(f"{name}: the pretended card has no operations that resize a tensor")
    if leaves or name == "aten._local_scalar_dense":
        return result
    if name == "aten.copy_" and not isinstance(args[0], CardTensor):
        return args[0]
    return return_and_correct_aliasing(func, args, kwargs, tree_map(_put, result))


def _may_mix(func: Any, args: tuple[Any, ...], elsewhere: list[Tensor]) -> bool:
    """Whether an operation with a tensor of the card accepts these tensors of the CPU."""
    name = str(func.overloadpacket)
    if name == "aten.copy_" or not elsewhere:
        return True
    writes_elsewhere = func._schema.is_mutable and not isinstance(args[0], CardTensor)
    return not writes_elsewhere and name not in _NO_SINGLE_NUMBERS and all(x.dim() == 0 for x in elsewhere)


def _is_by_mask(name: str, args: tuple[Any, ...]) -> bool:
    masks = (torch.bool, torch.uint8)
    return name in INDEXED and any(index is not None and index.dtype in masks for index in args[1])


def _held(x: Any) -> Any:
    return x.held if isinstance(x, CardTensor) else x


def _put(x: Any) -> Any:
    return CardTensor(x) if isinstance(x, Tensor) else x


def _made_elsewhere(operation: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def made(*args: Any, **kwargs: Any) -> Tensor:
        return CardTensor(operation(*args, **{**kwargs, "device": "cpu"}))

    return made


# What makes a tensor of nothing has no tensor to be asked by.
_FACTORIES = torch.library.Library("_", "IMPL")
_FACTORIES.fallback(_run, "PrivateUse1")
# PyTorch's own versions of these would resize an empty one.
_RESIZING = torch.library.Library("aten", "IMPL")
for _name in ("arange", "arange.start", "arange.start_step", "eye", "eye.m"):
    _packet, _, _overload = _name.partition(".")
    _operation = getattr(getattr(torch.ops.aten, _packet), _overload or "default")
    _RESIZING.impl(_name, _made_elsewhere(_operation), "PrivateUse1")


class _NumbersOfTheHost(TorchFunctionMode):
    """A `_NumbersOfTheHost` intercepts `torch.tensor` and similar functions, which copy numbers from the host."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        device = kwargs.get("device")
        if func in (torch.tensor, torch.as_tensor) and device is not None and torch.device(device).type == CARD.type:
            return func(*args, **{**kwargs, "device": "cpu"}).to(CARD)
        if func is Tensor.new_tensor and isinstance(args[0], CardTensor):
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype, **kwargs}).to(CARD)
        return func(*args, **kwargs)


_constants: dict[Any, Any] = {}


def _kept(constants: Any, values: Any, like: Tensor, make: Callable[[torch.dtype, torch.device], Any]) -> Any:
    """The constants of the card, kept as `numerics.tensors` keeps those of plain tensors."""
    key = (id(constants), values, like.dtype, like.device)
    if key not in _constants:
        _constants[key] = make(like.dtype, like.device)
    return _constants[key]


def _is_plain(tensor: Tensor) -> bool:
    """Whether a tensor counts as plain in `gradient_mode`, as those of a real card do."""
    return type(tensor) is CardTensor or gradient_mode.is_plain(tensor)


@contextmanager
def pretended_card() -> Iterator[torch.device]:
    """Make the device available in the body.

    The package treats subclasses of tensors as made by a tracer and keeps none of them, but here it must keep them.
    """
    replaced = {"_kept": _kept, "is_plain": _is_plain}
    of_package = [
        (module, name, vars(module)[name])
        for path, module in list(sys.modules.items())
        if path.startswith("directshape_torch.") and module is not gradient_mode
        for name in replaced.keys() & vars(module).keys()
    ]
    for module, name, _ in of_package:
        setattr(module, name, replaced[name])
    try:
        with _NumbersOfTheHost():
            yield CARD
    finally:
        for module, name, own in of_package:
            setattr(module, name, own)
