"""A region in which products of matrices have all the digits of their inputs."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

# "none": nobody has asked for fewer digits.
_FULL = ("none", "ieee")
# By this way of asking and not by names in `torch.backends`: it does not raise where old and new names were mixed.
_BACKENDS = ("cuda", "mkldnn")


@dataclass
class _Regions:
    """Those of all threads: the settings are the process's, so the first to come and the last to leave change them."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    inside: int = 0
    before: tuple[str, ...] = ()

    def enter(self) -> None:
        with self.lock:
            self.inside += 1
            if self.inside == 1:
                self.before = _asked()
                _ask(tuple(value if value in _FULL else "ieee" for value in self.before))

    def leave(self) -> None:
        with self.lock:
            self.inside -= 1
            if self.inside == 0:
                _ask(self.before)


_regions = _Regions()


@contextmanager
def full_precision(device_type: str) -> Iterator[None]:
    """No autocast, and no products of float32 with fewer digits, whatever the user has allowed for a network.

    Half precision cannot hold pixel coordinates, and TF32, which `torch.set_float32_matmul_precision("high")` allows
    on a graphics card, rounds a coordinate of 30 m to 2 cm. The user's settings are put back at the end. Other than
    autocast they belong to the process: in the meantime the products of its other threads are exact, too.

    Args:
        device_type: of the tensors, as in `torch.autocast`.

    Example:
        >>> with torch.autocast("cpu"), full_precision("cpu"):
        ...     (torch.eye(2) @ torch.eye(2)).dtype
        torch.float32
    """
    _regions.enter()
    try:
        with torch.autocast(device_type, enabled=False):
            yield
    finally:
        _regions.leave()


def _asked() -> tuple[str, ...]:
    return tuple(torch._C._get_fp32_precision_getter(backend, "matmul") for backend in _BACKENDS)


def _ask(values: tuple[str, ...]) -> None:
    for backend, now, value in zip(_BACKENDS, _asked(), values, strict=True):
        if now != value:
            torch._C._set_fp32_precision_setter(backend, "matmul", value)
