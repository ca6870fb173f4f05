"""This module refines the groups of a run by processes of this machine and handles groups whose process died."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from queue import SimpleQueue
from typing import Protocol, Self

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.frame_outputs import write_failure
from directshape_torch.batch.group_refinement import GroupReport, RunJob, refine_group, set_threads
from directshape_torch.errors import DirectShapeError

# A process may be killed by chance, because others take the memory.
_TRIES = 2
# If so many groups in a row for each process kill it, single frames are not the cause.
_HOPELESS_GROUPS = 5
_DEATH = "killed, out of memory or crashed"


class Engine(Protocol):
    """An `Engine` refines groups by processes, which end with the body."""

    workers: int  # processes side by side

    def submit(self, group: FrameGroup) -> Future[GroupReport]:
        """Hand out a group; any number of groups may wait."""
        ...

    def report(self, future: Future[GroupReport]) -> GroupReport | None:
        """The report of a group that has ended, or None if its process died; errors of the run raise."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def reports_of(engine: Engine, job: RunJob, groups: Sequence[FrameGroup]) -> Iterator[GroupReport]:
    """Reports of the groups of a run, in the order in which they end.

    A group whose process died is handed out again, then in halves, down to single frames, which have failed. Frames
    that were finished in spite of it are not repeated, since `refine_group` finds their files.

    Raises:
        DirectShapeError: processes die again and again, and none of them finishes a frame.
    """
    ended: SimpleQueue[Future[GroupReport]] = SimpleQueue()
    at_work: dict[Future[GroupReport], tuple[FrameGroup, int]] = {}
    num_deaths = 0

    def hand_out(more: Sequence[FrameGroup], attempt: int = 1) -> None:
        for group in more:
            future = engine.submit(group)
            at_work[future] = group, attempt
            future.add_done_callback(ended.put)

    hand_out(groups)
    while at_work:
        future = ended.get()
        group, attempt = at_work.pop(future)
        if (report := engine.report(future)) is not None:
            num_deaths = 0
            yield report
            continue
        # A frame that kills its worker does so in halves and repetitions too, so each whole group is counted once.
        num_deaths += attempt == 1 and group in groups
        if num_deaths >= _HOPELESS_GROUPS * engine.workers:
            raise DirectShapeError(f"workers die again and again ({_DEATH}); is there enough memory?")
        if attempt < _TRIES:
            hand_out([group], attempt + 1)
        elif len(group.frame_ids) > 1:
            hand_out(group.halves())
        else:
            reason = f"its worker died each of {_TRIES} times ({_DEATH})"
            yield GroupReport({lost: write_failure(job.out_dir, lost, reason) for lost in group.wanted})


class LocalEngine:
    """A `LocalEngine` has processes of this machine; each starts with its first group.

    Each process is an executor of its own with a thread that waits for it, so the death of a process affects only its
    own group. At the end of the body the processes finish their groups. They also end whenever this process ends.
    """

    def __init__(self, job: RunJob, workers: int) -> None:
        # Bytes make sure that tensors are copied and not shared.
        self._job, self.workers = pickled(job), workers
        # If a thread started the tracker, it would unblock interrupts in that thread.
        resource_tracker.ensure_running()
        self._threads = ThreadPoolExecutor(workers, initializer=_block_interrupts)
        self._executors: SimpleQueue[ProcessPoolExecutor | None] = SimpleQueue()
        for _ in range(workers):
            self._executors.put(None)

    def submit(self, group: FrameGroup) -> Future[GroupReport]:
        return self._threads.submit(self._refine, group)

    def report(self, future: Future[GroupReport]) -> GroupReport | None:
        try:
            return future.result()
        except BrokenProcessPool:
            return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(cancel_futures=True)
        while self._executors.qsize():
            if (executor := self._executors.get()) is not None:
                executor.shutdown()

    def _refine(self, group: FrameGroup) -> GroupReport:
        executor = self._executors.get()
        try:
            executor = executor or self._started()
            return executor.submit(_refine_here, group).result()
        except BrokenProcessPool:
            executor = None
            raise
        finally:
            self._executors.put(executor)

    def _started(self) -> ProcessPoolExecutor:
        """An executor of one process that has read the job."""
        # Processes are spawned and not forked, because threads of PyTorch do not survive a fork.
        executor = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _end_with_parent)
        # The job is a call of its own and no argument of the start, where the executor waits for ever for a process
        # that died before it had read much.
        problem = executor.submit(_take_job, self._job).result()
        if problem is not None:
            executor.shutdown()
            raise DirectShapeError(f"a worker cannot read the job: {problem}")
        return executor


def pickled(job: RunJob) -> bytes:
    """A job as bytes.

    Raises:
        DirectShapeError: a part of it, such as a local function of the user, cannot be sent to other processes.
    """
    try:
        return pickle.dumps(job)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise DirectShapeError(f"the job cannot be sent to other processes: {error}") from error


def _block_interrupts() -> None:
    """Let processes that this thread starts ignore Ctrl-C, which all processes receive and only the parent handles.

    The signal is blocked from the start of a process, which imports for seconds before it could ignore the signal.
    """
    if hasattr(signal, "pthread_sigmask"):  # only Unix has it
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _end_with_parent() -> None:
    """Let this process end when its parent ends, in whatever way; an executor would wait for groups for ever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for systems where it could not be blocked
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker was started by nobody"

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# A worker process has one job, others have none.
_jobs: list[RunJob] = []


def _take_job(content: bytes) -> str | None:
    """Read the job in a worker; return why it cannot be read, or None."""
    try:
        _jobs.append(pickle.loads(content))
    # A user's own classes may raise any error when they are loaded in another process.
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    set_threads(_jobs[0].options.threads_per_worker)
    return None


def _refine_here(group: FrameGroup) -> GroupReport:
    try:
        return refine_group(_jobs[0], group)
    # An error of a user's own class that the parent cannot read would look like the death of this process.
    except Exception as error:
        if type(error).__module__.startswith("directshape_torch."):
            raise
        raise DirectShapeError(f"{type(error).__name__}: {error}") from None
