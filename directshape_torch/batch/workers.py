"""Hands the groups of a run to whoever does the work, and decides what happens to those whose worker died."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Protocol

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.group_refinement import GroupRefiner, GroupReport
from directshape_torch.errors import DirectShapeError

# So many deaths before anything was ever finished are not the fault of single frames.
_HOPELESS_DEATHS = 6


class WorkerDiedError(Exception):
    """The process that worked on a group ended without an answer.

    Args:
        reason: what is known of it.
    """


class Workers(Protocol):
    """Processes that refine groups of frames."""

    @property
    def capacity(self) -> int:
        """How many groups may be handed out at once."""
        ...

    def hand_out(self, group: FrameGroup) -> None:
        """Start to work on a group."""
        ...

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | WorkerDiedError]]:
        """Wait until at least one group has come back."""
        ...

    def close(self) -> None:
        """Let the groups that are being worked on come to their end, then stop."""
        ...


class ThisProcess:
    """No other process: each group is refined when its report is asked for."""

    capacity = 1

    def __init__(self, refiner: GroupRefiner) -> None:
        self._refiner = refiner
        self._handed_out: deque[FrameGroup] = deque()

    def hand_out(self, group: FrameGroup) -> None:
        """Note it."""
        self._handed_out.append(group)

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | WorkerDiedError]]:
        """Refine the group."""
        group = self._handed_out.popleft()
        return [(group, self._refiner.refine(group))]

    def close(self) -> None:
        """Nothing."""


class GroupDispatch:
    """The groups of a run on their way through some workers.

    Args:
        groups: in the order of the data set.
        workers: who refines them.
        retries: how often a group whose worker died is handed out again; then by halves, down to single frames.
        finished: tells which of some frames have been noted as finished, after a death.

    Attributes:
        num_deaths: of workers so far.
        lost: frames whose worker died each time, with the reason.
    """

    def __init__(
        self,
        groups: Sequence[FrameGroup],
        workers: Workers,
        retries: int,
        finished: Callable[[Collection[str]], Collection[str]],
    ) -> None:
        self._waiting = deque(groups)
        self._workers, self._retries, self._finished = workers, retries, finished
        self._deaths: Counter[tuple[str, ...]] = Counter()
        self.num_deaths = 0
        self.lost: dict[str, str] = {}

    def reports(self) -> Iterator[GroupReport]:
        """The reports, in the order in which they come.

        Raises:
            DirectShapeError: workers die before any of them has finished anything.
        """
        num_handed_out, num_reports = 0, 0
        while self._waiting or num_handed_out:
            while self._waiting and num_handed_out < self._workers.capacity:
                self._workers.hand_out(self._waiting.popleft())
                num_handed_out += 1
            for group, report in self._workers.next_reports():
                num_handed_out -= 1
                if isinstance(report, WorkerDiedError):
                    self._retry(group, report, is_hopeless=not num_reports)
                else:
                    num_reports += 1
                    yield report

    def _retry(self, group: FrameGroup, death: WorkerDiedError, is_hopeless: bool) -> None:
        self.num_deaths += 1
        self._deaths[group.frame_ids] += 1
        if is_hopeless and self.num_deaths >= _HOPELESS_DEATHS * self._workers.capacity:
            raise DirectShapeError(f"workers die before they finish any frame ({death}); is there enough memory?")
        group = group.without(self._finished(group.wanted))
        if not group.wanted:
            return
        if self._deaths[group.frame_ids] <= self._retries:
            self._waiting.appendleft(group)
        elif len(group.frame_ids) > 1:
            self._waiting.extendleft(reversed(group.halves()))
        else:
            times = self._deaths[group.frame_ids]
            self.lost[group.frame_ids[0]] = f"its worker died each of {times} times ({death})"
