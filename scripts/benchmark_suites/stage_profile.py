"""This module runs `--profile`: time and operations of one eager call by part, without changes of the measured code.

Python calls a hook at the begin and end of every function. The time between two events, and the operations in it,
belong to the innermost running function of `PARTS`; other functions count for their callers. Parts are exclusive and
add up to the whole, so a lookup counts for its caller. The outcome of a result counts as a whole.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from types import CodeType, FrameType
from typing import Any

from benchmark_suites.measures import OperationCount
from benchmark_suites.timing import Row, Spread
from benchmark_suites.workloads import demo_scene
from directshape_torch.io.frame_collation import collate
from directshape_torch.refinement.make_result import result_of
from directshape_torch.refinement.problem import CarIterations, CarProblem, CarStage
from directshape_torch.refinement.scene_problem import problem_of_scene
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.iteration import iterate
from directshape_torch.state.unknowns import Unknowns
from directshape_torch.terms import depth, term
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.priors import PriorTerm
from directshape_torch.terms.silhouette import Silhouettes

_REST = "everything else"
_RESULT = "result: covariance, quality, profile, trust"
# The functions themselves are listed, so that removing one makes its line fail.
PARTS: dict[str, tuple[Any, ...]] = {
    "observation: regions, occlusion, pixels": (DirectShapeRefiner._observe, problem_of_scene),
    "marched rays and first hits": (CarProblem.prepare,),
    "tracked rays": (depth.tracked_closest, depth.tracked_depth),
    "beginning of stages": (CarProblem.begin, CarStage.start),
    "grids of the cars": (PCAShapePrior.bind,),
    "silhouettes": (Silhouettes.linear, Silhouettes.native_part),
    "photometric": (Photometric.linear, Photometric.native_part),
    "priors": (PriorTerm.linear,),
    "sums over pixels and cars": (term.part_of, term.summed),
    "solve and step": (damped_step, Unknowns.retract),
    "iterations, the rest": (iterate, CarIterations.choose),
    "figures at the end": (CarStage.figures,),
    _RESULT: (result_of,),
}


def profile_rows(rounds: int) -> list[Row]:
    """Rows with milliseconds and operations of each part of a call of the bundled frame, default settings."""
    call = partial(DirectShapeRefiner(), *collate(demo_scene().frames))
    call()
    times = [profile_parts(call, time.perf_counter) for _ in range(rounds)]
    with OperationCount() as count:
        operations = profile_parts(call, lambda: count.total)
    whole = Spread.of([1e3 * sum(each.values()) for each in times])
    rows = []
    for part in (*PARTS, _REST):
        spread = Spread.of([1e3 * each[part] for each in times])
        note = f"{100 * spread.median / whole.median:.1f} %, {operations[part]:.0f} operations"
        rows.append(Row(f"{part}: ms", spread, note))
    return [*rows, Row("whole call, with the hook's own cost: ms", whole, f"{count.total} operations")]


def profile_parts(call: Callable[[], object], reading: Callable[[], float]) -> Counter[str]:
    """Run `call` once in this thread and return the increase of a reading in each of `PARTS` and in the rest.

    Args:
        call: what is run.
        reading: reading of a clock or a counter.
    """
    recorder = _Recorder(reading)
    previous = sys.getprofile()
    sys.setprofile(recorder.event)
    try:
        call()
    finally:
        sys.setprofile(previous)
    return recorder.risen


class _Recorder:
    """A `_Recorder` has the stack of the parts of the running functions."""

    def __init__(self, reading: Callable[[], float]) -> None:
        self.risen: Counter[str] = Counter()
        self._parts = {_code(function): part for part, functions in PARTS.items() for function in functions}
        self._stack, self._reading, self._last = [_REST], reading, reading()

    def event(self, frame: FrameType, event: str, argument: Any) -> None:
        if event not in ("call", "return"):
            return
        self.risen[self._stack[-1]] += self._reading() - self._last  # type: ignore[assignment]
        if event == "call":
            caller = self._stack[-1]
            self._stack.append(caller if caller == _RESULT else self._parts.get(frame.f_code, caller))
        elif len(self._stack) > 1:  # functions that were running before the hook was set return too
            self._stack.pop()
        self._last = self._reading()


def _code(function: Any) -> CodeType:
    """The code of a function, a method, or of the function that they wrap."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    assert isinstance(code, CodeType), function
    return code
