"""A region in which products of matrices have all the digits of their inputs."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import torch

# "none": nobody has asked for fewer digits.
_FULL = ("none", "ieee")
# By this way of asking and not by names in `torch.backends`: it does not raise where old and new names were mixed.
_BACKENDS = ("cuda", "mkldnn")


class _Setting(NamedTuple):
    """Which precisions of matrix products the user has allowed."""

    by_old_name: str | None  # of `torch.set_float32_matmul_precision`; None where the newer names are in use
    asked: tuple[str, ...]  # of each backend

    @classmethod
    def now(cls) -> _Setting:
        try:
            by_old_name = torch.get_float32_matmul_precision()
        except RuntimeError:  # the newer names are in use, and both together are refused
            by_old_name = None
        return cls(by_old_name, tuple(_asked(backend) for backend in _BACKENDS))

    def suspend(self) -> None:
        """Allow nothing, by the names that the user uses."""
        if self.by_old_name not in (None, "highest"):
            torch.set_float32_matmul_precision("highest")
            return
        for backend, value in zip(_BACKENDS, self.asked, strict=True):
            if value not in _FULL:
                torch._C._set_fp32_precision_setter(backend, "matmul", "ieee")

    def restore(self) -> None:
        """Allow again what was allowed before `suspend`."""
        if self.by_old_name not in (None, "highest"):
            torch.set_float32_matmul_precision(self.by_old_name)
            return
        for backend, value in zip(_BACKENDS, self.asked, strict=True):
            if value not in _FULL:
                # As if nobody had asked: what then comes from `torch.backends.fp32_precision` goes on following it.
                torch._C._set_fp32_precision_setter(backend, "matmul", "none")
                if _asked(backend) != value:
                    torch._C._set_fp32_precision_setter(backend, "matmul", value)


def _asked(backend: str) -> str:
    return torch._C._get_fp32_precision_getter(backend, "matmul")


@dataclass
class _Regions:
    """The regions of all threads: the setting is the process's; the first to come and the last to leave change it."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    inside: int = 0
    before: _Setting | None = None

    def enter(self) -> None:
        with self.lock:
            if self.before is None:
                self.before = _Setting.now()
                self.before.suspend()
            self.inside += 1

    def leave(self) -> None:
        with self.lock:
            self.inside -= 1
            if self.inside == 0 and self.before is not None:
                self.before.restore()
                self.before = None


_regions = _Regions()


@contextmanager
def full_precision(device_type: str) -> Iterator[None]:
    """No autocast on devices of a type, and no products of float32 with fewer digits, whatever the user has allowed.

    Half precision cannot hold pixel coordinates, and TF32, which `torch.set_float32_matmul_precision("high")` allows
    on a graphics card, rounds a coordinate of 30 m to 2 cm. The user's setting is put back at the end. Other than
    autocast it belongs to the process: in the meantime the products of its other threads are exact, too.
    """
    _regions.enter()
    try:
        with torch.autocast(device_type, enabled=False):
            yield
    finally:
        _regions.leave()
