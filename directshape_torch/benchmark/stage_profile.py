"""Where the time of one call goes, by stages, without a line of measurement in the code that is measured.

Python tells a hook of every function that begins and ends. The time between two events belongs to the innermost
running function that has a stage (`stage_rules`), so a lookup counts where it is asked for; but what follows after the
last iteration counts as a whole. Times are exclusive: every moment counts once, and the stages add up to the whole. The
hook costs about a microsecond an event, which stages of many small functions pay most of.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import CodeType, FrameType
from typing import Any, NamedTuple

from directshape_torch.benchmark.stage_rules import STAGES, Rule, Stage, rule_of

_OUTSIDE: Stage = "bookkeeping"


@dataclass
class StageProfile:
    """Seconds of one call.

    Attributes:
        seconds: by stage, every stage present.
        unattributed: seconds by the name of the function that no rule knows, helpers that it called included.
    """

    seconds: dict[Stage, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    unattributed: dict[str, float] = field(default_factory=dict)

    @property
    def total_s(self) -> float:
        return sum(self.seconds.values())

    def share(self, stage: Stage) -> float:
        """Of the whole, 0 to 1."""
        return self.seconds[stage] / self.total_s if self.total_s > 0 else 0.0


def profile_stages(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> StageProfile:
    """Run `call` once in this thread and attribute its time.

    Args:
        call: eager code; of compiled code only the call as a whole is seen.
        clock: seconds from any origin.
    """
    recorder = _Recorder(clock)
    previous = sys.getprofile()
    sys.setprofile(recorder.event)
    try:
        call()
    finally:
        sys.setprofile(previous)
    return recorder.profile


class _Running(NamedTuple):
    """A running function."""

    stage: Stage
    name: str
    encloses: bool


class _Recorder:
    """Stack of the running functions."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.profile = StageProfile()
        self._clock = clock
        self._stack = [_Running(_OUTSIDE, "", False)]
        self._known: dict[CodeType, tuple[Rule, str]] = {}
        self._last = clock()

    def event(self, frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            self._charge()
            self._stack.append(self._running(frame))
            self._last = self._clock()
        elif event == "return":
            self._charge()
            # Functions that were running before the hook was set return too.
            if len(self._stack) > 1:
                self._stack.pop()
            self._last = self._clock()

    def _charge(self) -> None:
        elapsed = self._clock() - self._last
        stage, name, _ = self._stack[-1]
        self.profile.seconds[stage] += elapsed
        if stage == "unattributed":
            self.profile.unattributed[name] = self.profile.unattributed.get(name, 0.0) + elapsed

    def _running(self, frame: FrameType) -> _Running:
        caller = self._stack[-1]
        if caller.encloses:
            return caller
        if frame.f_code not in self._known:
            module, function = str(frame.f_globals.get("__name__", "")), frame.f_code.co_qualname
            self._known[frame.f_code] = rule_of(module, function), f"{module}.{function}"
        rule, name = self._known[frame.f_code]
        return caller if rule.stage is None else _Running(rule.stage, name, rule.encloses)
