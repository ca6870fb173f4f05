"""Other processes that refine the groups of a run, and what happens to those whose worker died."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Self

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.frame_outputs import failed_entry
from directshape_torch.batch.group_refinement import GroupReport, RunJob, limited_threads, refine_group
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.run_manifest import FrameEntry

# So many deaths before anything was ever finished are not the fault of single frames.
_HOPELESS_DEATHS = 6
_DEATH = "killed, out of memory or crashed"
# Of a message that is cut short a plain OSError is raised.
_NOTHING_COMES = (EOFError, OSError)


def reports_of(
    workers: LocalWorkers, groups: Sequence[FrameGroup], retries: int, entry_of: Callable[[str], FrameEntry | None]
) -> Iterator[GroupReport]:
    """What became of the groups of a run, in the order in which they end.

    A group whose worker died is handed out again `retries` times, then by halves, down to single frames, without those
    that are finished after all, as `entry_of` says. A frame whose worker died each time has failed.

    Raises:
        DirectShapeError: workers die before any of them has finished anything.
    """
    waiting, deaths = deque(groups), Counter[tuple[str, ...]]()
    num_handed_out, has_report = 0, False
    while waiting or num_handed_out:
        while waiting and num_handed_out < workers.capacity:
            workers.hand_out(waiting.popleft())
            num_handed_out += 1
        for group, report in workers.next_reports():
            num_handed_out -= 1
            if report is not None:
                has_report = True
                yield report
                continue
            deaths[group.frame_ids] += 1
            if not has_report and deaths.total() >= _HOPELESS_DEATHS * workers.capacity:
                raise DirectShapeError(f"workers die before they finish any frame ({_DEATH}); is there enough memory?")
            found = {frame_id: entry_of(frame_id) for frame_id in sorted(group.wanted)}
            ends = {frame_id: entry for frame_id, entry in found.items() if entry is not None}
            group, times = group.without(ends), deaths[group.frame_ids]
            if group.wanted and times <= retries:
                waiting.appendleft(group)
            elif len(group.frame_ids) > 1:
                waiting.extendleft(reversed(group.halves()))
            else:
                ends |= {
                    lost: failed_entry(f"its worker died each of {times} times ({_DEATH})") for lost in group.wanted
                }
            yield GroupReport(ends)


@dataclass
class _Worker:
    """A process, the pipe to it and what it is doing; the job goes through the pipe with the first group."""

    process: SpawnProcess
    pipe: Connection
    has_job: bool = False
    group: FrameGroup | None = None


class LocalWorkers:
    """Processes, started with the first group, so that a death has one culprit and disturbs nobody else.

    Each has a pipe whose other end this process alone holds: however early a worker dies, the pipe ends. The standard
    pools hold both ends, and wait for ever for a worker that died before it had read all of a large job.

    Processes are spawned and not forked: threads of PyTorch do not survive a fork. They end with their parent, however
    that ends. When the body ends, they finish the groups at hand. It may be interrupted anywhere: each worker is among
    the others from before its process starts until it has ended, or nobody would close its pipe.
    """

    def __init__(self, job: RunJob, num_workers: int, threads: int | None) -> None:
        try:
            # As bytes: tensors are copied and not shared.
            self._job, self._threads = pickle.dumps(job), threads
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise DirectShapeError(f"the job cannot be sent to other processes: {error}") from error
        self.capacity = num_workers  # one group for each
        self._workers: list[_Worker] = []

    def hand_out(self, group: FrameGroup) -> None:
        """Give a group to an idle process."""
        # All of them start before the first waits for one to read a large job.
        while len(self._workers) < self.capacity:
            self._start_worker()
        worker = next(each for each in self._workers if each.group is None)
        worker.group = group
        # One that is dead says so by its pipe, to whoever waits for the report.
        with suppress(ConnectionError):
            if not worker.has_job:
                worker.pipe.send_bytes(self._job)
                worker.has_job = True
            worker.pipe.send(group)

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | None]]:
        """Wait for any process; of a group whose worker died there is no report.

        Raises:
            DirectShapeError: a worker cannot read the job.
        """
        groups = {worker.pipe: (worker, worker.group) for worker in self._workers if worker.group is not None}
        ready = [groups[pipe] for pipe in wait(groups) if isinstance(pipe, Connection)]
        return [(group, self._report(worker)) for worker, group in ready]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            if worker.process.pid is not None:
                worker.process.join()

    def _report(self, worker: _Worker) -> GroupReport | None:
        report: GroupReport | str | None = None
        try:
            report = worker.pipe.recv()
            worker.group = None
        except _NOTHING_COMES:
            worker.pipe.close()
            worker.process.join()
            self._workers.remove(worker)
        if isinstance(report, str):
            raise DirectShapeError(f"a worker cannot read the job: {report}")
        return report

    def _start_worker(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        worker = _Worker(context.Process(target=_work, args=(theirs, self._threads)), ours)
        self._workers.append(worker)
        with _deaf_to_interrupts():
            worker.process.start()
        theirs.close()


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes that start in the body never hear Ctrl-C, which reaches all of them; the parent decides what it means.

    From their first moment: until they could ignore it themselves, they import for seconds.
    """
    if not hasattr(signal, "pthread_sigmask"):  # only Unix has it
        yield
        return
    resource_tracker.ensure_running()  # with the first process, it would let interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(pipe: Connection, threads: int | None) -> None:
    """The life of a worker: the job, then groups until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for systems where it could not be blocked
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job: RunJob | str | None = None
    with limited_threads(threads):
        for message in _messages(pipe):
            if job is None:
                job = _loaded(message)
                continue
            report = job if isinstance(job, str) else refine_group(job, pickle.loads(message))
            try:
                pipe.send(report)
            except ConnectionError:
                return


def _messages(pipe: Connection) -> Iterator[bytes]:
    """Until the pipe ends."""
    with suppress(*_NOTHING_COMES):
        while True:
            yield pipe.recv_bytes()


def _loaded(content: bytes) -> RunJob | str:
    """The job, or why it cannot be read."""
    try:
        job: RunJob = pickle.loads(content)
    # Whatever the code of a user's own classes raises in another process.
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return job


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker was started by nobody"
    parent.join()
    os._exit(1)
