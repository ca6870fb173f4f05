"""This module measures the native loops of whole calls alone, on the arguments that the calls gave them.

Their time is a bound of our own: a call would take it if nothing but its loops ran.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmark_suites.measures import Row, Spread, time_interleaved
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch
from directshape_torch.errors import MissingDependencyError
from directshape_torch.kernels.arguments import Rays

_OF_ROWS = "march", "silhouettes", "photometric"


class Record:
    """A `Record` holds calls of loops in their order, and the numbers of their arguments when each came first."""

    def __init__(self) -> None:
        self.calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._numbers: dict[object, tuple[NDArray[Any], NDArray[Any]]] = {}

    def call(self, loop: Callable[..., Any], *arguments: Any) -> Any:
        """Call and record a loop."""
        for array in _arrays(arguments):
            place = array.ctypes.data, array.shape, array.strides
            self._numbers.setdefault(place, (array, array.copy()))
        self.calls.append((loop, arguments))
        return loop(*arguments)

    def restore(self) -> None:
        """Give all arguments their numbers again, because loops write to them."""
        for array, numbers in self._numbers.values():
            array[...] = numbers

    def repeat(self) -> None:
        self.restore()
        for loop, arguments in self.calls:
            loop(*arguments)


def _arrays(value: object) -> Iterator[NDArray[Any]]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for each in value:
            yield from _arrays(each)


def loops_row(name: str, calls: Sequence[tuple[FrameBatch, Detections]], rounds: int) -> Row:
    """Milliseconds of the native loops of whole calls, repeated with their arguments: a call that does nothing else.

    Raises:
        MissingDependencyError: Numba is not installed.
    """
    refiner, seconds, sizes = DirectShapeRefiner(), [], []
    for call in calls:
        refine = partial(refiner, *call)
        with torch.no_grad():
            refine()  # The first use of the loops looks at their compiled code.
            with recorded_loops() as record:
                refine()
            sides = {"call": refine, "loops": record.repeat, "restore": record.restore}
            times = time_interleaved(sides, rounds, of_processor=True)
            seconds.append({"call": times["call"], "loops": times["loops"] - times["restore"]})
        sizes.append({name: [_num_rows(a) for loop, a in record.calls if loop.__name__ == name] for name in _OF_ROWS})
    whole, share = (median(1e3 * s["call"] for s in seconds), median(s["loops"] / s["call"] for s in seconds))
    each = ", ".join(
        f"{median(len(call[name]) for call in sizes):g} of {name} ({median(sum(call[name]) for call in sizes):g} rows)"
        for name in _OF_ROWS
    )
    note = f"{share:.2g} of the {whole:.4g} ms of a call; {each}"
    return Row(f"{name}, loops alone: ms", Spread.of([1e3 * s["loops"] for s in seconds]), note)


@contextmanager
def recorded_loops() -> Iterator[Record]:
    """A region whose native loops are recorded with their arguments, in order."""
    try:
        from directshape_torch.kernels import extents, iterations, march, photometric, priors, shifts, silhouettes
    except ImportError as error:
        raise MissingDependencyError("numba", "fast", "the time of native loops alone") from error
    record = Record()
    loops = (
        *((march, "march"), (silhouettes, "silhouettes"), (photometric, "photometric"), (priors, "priors")),
        *((iterations, "propose"), (iterations, "decide"), (shifts, "shifted"), (extents, "extents")),
    )
    compiled = [getattr(module, name) for module, name in loops]
    for (module, name), loop in zip(loops, compiled, strict=True):
        setattr(module, name, partial(record.call, loop))
    try:
        yield record
    finally:
        for (module, name), loop in zip(loops, compiled, strict=True):
            setattr(module, name, loop)


def _num_rows(arguments: tuple[Any, ...]) -> int:
    """The number of rays of a loop, with the empty places of their blocks."""
    return sum(each.ray_cam[0].size for each in arguments if isinstance(each, Rays))
