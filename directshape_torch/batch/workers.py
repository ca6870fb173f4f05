"""This module refines the groups of a run in other processes and handles groups whose worker died."""

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

# If this many workers die before any frame is finished, single frames are not the cause.
_HOPELESS_DEATHS = 6
_DEATH = "killed, out of memory or crashed"
# A message that is cut short raises a plain OSError.
_NOTHING_COMES = (EOFError, OSError)


def reports_of(
    workers: LocalWorkers, groups: Sequence[FrameGroup], retries: int, entry_of: Callable[[str], FrameEntry | None]
) -> Iterator[GroupReport]:
    """Reports of the groups of a run, in the order in which they end.

    A group whose worker died is handed out again `retries` times, then in halves, down to single frames. Frames that
    were finished in spite of it, according to `entry_of`, are not repeated. A frame whose worker died each time has
    failed.

    Raises:
        DirectShapeError: workers die before any of them has finished a frame.
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
    """A `_Worker` is a process with its pipe and its current group; the job is sent with the first group."""

    process: SpawnProcess
    pipe: Connection
    has_job: bool = False
    group: FrameGroup | None = None


class LocalWorkers:
    """A `LocalWorkers` has processes for groups of frames; they start with the first group.

    The death of a process affects only its own group. Each process has a pipe whose other end only this process holds,
    so the pipe ends whenever the worker dies. (The standard pools hold both ends, and wait for ever for a worker that
    died before it had read a large job.)

    Processes are spawned and not forked, because threads of PyTorch do not survive a fork. They end with their parent,
    in whatever way that ends. At the end of the body they finish their current groups. The body may be interrupted
    anywhere, so a worker is in the list from before its process starts until it has ended; its pipe is then always
    closed.
    """

    def __init__(self, job: RunJob, num_workers: int, threads: int | None) -> None:
        try:
            # Bytes make sure that tensors are copied and not shared.
            self._job, self._threads = pickle.dumps(job), threads
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise DirectShapeError(f"the job cannot be sent to other processes: {error}") from error
        self.capacity = num_workers  # one group for each
        self._workers: list[_Worker] = []

    def hand_out(self, group: FrameGroup) -> None:
        """Give a group to an idle process."""
        # All processes start before this one waits for a process to read a large job.
        while len(self._workers) < self.capacity:
            self._start_worker()
        worker = next(each for each in self._workers if each.group is None)
        worker.group = group
        # The pipe of a dead process tells its death to the caller of `next_reports`.
        with suppress(ConnectionError):
            if not worker.has_job:
                worker.pipe.send_bytes(self._job)
                worker.has_job = True
            worker.pipe.send(group)

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | None]]:
        """Wait for any process; the report of a group whose worker died is None.

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
    """Start processes in the body that ignore Ctrl-C, which all processes receive and only the parent handles.

    The signal is blocked from the start of a process, which imports for seconds before it could ignore the signal.
    """
    if not hasattr(signal, "pthread_sigmask"):  # only Unix has it
        yield
        return
    resource_tracker.ensure_running()  # if the first process started it, it would unblock interrupts again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(pipe: Connection, threads: int | None) -> None:
    """Run a worker: read the job, then refine groups until the pipe ends."""
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
    """The messages of a pipe until it ends."""
    with suppress(*_NOTHING_COMES):
        while True:
            yield pipe.recv_bytes()


def _loaded(content: bytes) -> RunJob | str:
    """The job, or why it cannot be read."""
    try:
        job: RunJob = pickle.loads(content)
    # A user's own classes may raise any error when they are loaded in another process.
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return job


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker was started by nobody"
    parent.join()
    os._exit(1)
