"""Who refines the groups of a run, this process or others, and what happens to those whose worker died."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Protocol

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.group_refinement import GroupReport, RunJob, limited_threads, refine_group
from directshape_torch.errors import DirectShapeError

# So many deaths before anything was ever finished are not the fault of single frames.
_HOPELESS_DEATHS = 6
# The other end is gone, or went in the middle of something.
_PIPE_ENDED = (EOFError, ConnectionError)


class WorkerDiedError(Exception):
    """The process that worked on a group ended without an answer."""


_Outcomes = list[tuple[FrameGroup, GroupReport | WorkerDiedError]]


class Workers(Protocol):
    """Refine groups of frames: `capacity` at once; `close` lets those at hand come to their end."""

    @property
    def capacity(self) -> int: ...

    def hand_out(self, group: FrameGroup) -> None: ...

    def next_reports(self) -> _Outcomes: ...

    def close(self) -> None: ...


class GroupDispatch:
    """The groups of a run on their way through some workers.

    A group whose worker died is handed out again `retries` times, then by halves, down to single frames, without what
    `finished` notes to be done after all. `lost` are the frames whose worker died each time, with the reason.
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


class ThisProcess:
    """No other process: each group is refined when its report is asked for."""

    capacity = 1

    def __init__(self, job: RunJob) -> None:
        self._job = job
        self._handed_out: deque[FrameGroup] = deque()

    def hand_out(self, group: FrameGroup) -> None:
        """Note it."""
        self._handed_out.append(group)

    def next_reports(self) -> _Outcomes:
        """Refine the group."""
        group = self._handed_out.popleft()
        return [(group, refine_group(self._job, group))]

    def close(self) -> None:
        """Nothing."""


@dataclass
class _Worker:
    """A process; the job goes through its pipe with the first group."""

    process: SpawnProcess
    pipe: Connection
    has_job: bool = False


class LocalWorkers:
    """A process for each worker, so that a death has one culprit and disturbs nobody else.

    Each has a pipe whose other end this process alone holds: however early a worker dies, the pipe ends. The standard
    pools hold both ends, and wait for ever for a worker that died before it had read all of a large job.

    Processes are spawned and not forked: threads of PyTorch do not survive a fork. They end with their parent, however
    that ends.
    """

    def __init__(self, job: RunJob, num_workers: int, threads: int | None) -> None:
        try:
            # As bytes: tensors are copied and not shared.
            self._job, self._threads = pickle.dumps(job), threads
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise DirectShapeError(f"the job cannot be sent to other processes: {error}") from error
        self._idle = [self._new_worker() for _ in range(num_workers)]
        self._busy: dict[Connection, tuple[FrameGroup, _Worker]] = {}

    @property
    def capacity(self) -> int:
        """One group for each process."""
        return len(self._idle) + len(self._busy)

    def hand_out(self, group: FrameGroup) -> None:
        """Give a group to an idle process."""
        worker = self._idle.pop()
        self._busy[worker.pipe] = group, worker
        try:
            if not worker.has_job:
                worker.pipe.send_bytes(self._job)
                worker.has_job = True
            worker.pipe.send(group)
        except _PIPE_ENDED:
            # It is dead, as its pipe tells whoever waits for the report.
            return

    def next_reports(self) -> _Outcomes:
        """Wait for any process.

        Raises:
            DirectShapeError: a worker cannot read the job.
        """
        return [self._report(pipe) for pipe in wait(self._busy) if isinstance(pipe, Connection)]

    def close(self) -> None:
        """Stop the processes after the groups at hand."""
        workers = [*self._idle, *(worker for _, worker in self._busy.values())]
        for worker in workers:
            worker.pipe.close()
        for worker in workers:
            worker.process.join()

    def _report(self, pipe: Connection) -> tuple[FrameGroup, GroupReport | WorkerDiedError]:
        group, worker = self._busy.pop(pipe)
        try:
            report: GroupReport | WorkerDiedError | str = pipe.recv()
        except _PIPE_ENDED:
            pipe.close()
            worker.process.join()
            worker = self._new_worker()
            report = WorkerDiedError("killed, out of memory or crashed")
        self._idle.append(worker)
        if isinstance(report, str):
            raise DirectShapeError(f"a worker cannot read the job: {report}")
        return group, report

    def _new_worker(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, self._threads))
        process.start()
        theirs.close()
        return _Worker(process, ours)


def _work(pipe: Connection, threads: int | None) -> None:
    """The life of a worker: the job, then groups until the pipe ends."""
    # Ctrl-C reaches the whole group of processes; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(*_PIPE_ENDED), limited_threads(threads):
        job = _loaded(pipe.recv_bytes())
        while True:
            group = pipe.recv()
            pipe.send(job if isinstance(job, str) else refine_group(job, group))


def _loaded(content: bytes) -> RunJob | str:
    """Or why it cannot be: whatever the code of a user's own classes raises in another process."""
    try:
        job: RunJob = pickle.loads(content)
        return job
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker was started by nobody"
    parent.join()
    os._exit(1)
