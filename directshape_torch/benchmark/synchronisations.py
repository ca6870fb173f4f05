"""How often the processor waits for the graphics card: PyTorch's own warnings, counted."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

_WARNING = "synchronizing CUDA operation"


@dataclass
class SynchronisationCount:
    """Synchronisations by the place in the program that made them, file and line."""

    by_place: dict[str, int] = field(default_factory=dict)

    @property
    def total(self) -> int:
        return sum(self.by_place.values())

    def add(self, caught: list[warnings.WarningMessage]) -> None:
        """Count those among the warnings that tell of a synchronisation."""
        for warning in caught:
            if _WARNING in str(warning.message):
                place = f"{warning.filename}:{warning.lineno}"
                self.by_place[place] = self.by_place.get(place, 0) + 1


def count_synchronisations(call: Callable[[], object]) -> SynchronisationCount:
    """Synchronisations with the graphics card that `call` makes by PyTorch's operations.

    Other warnings of the call are not shown.
    """
    count = SynchronisationCount()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with _synchronisations_warn():
            call()
    count.add(caught)
    return count


@contextmanager
def _synchronisations_warn() -> Iterator[None]:
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(before)
