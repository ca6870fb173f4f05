"""Worker processes on this machine, by the standard library's process pools."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.group_refinement import (
    GroupRefiner,
    GroupReport,
    RunJob,
    dump_job,
    limit_threads,
    load_job,
)
from directshape_torch.batch.workers import WorkerDiedError


@dataclass
class _Process:
    """What this worker process keeps: the job as it came, and as it was read with the first group."""

    content: bytes = b""
    refiner: GroupRefiner | None = None


_process = _Process()


class LocalWorkers:
    """One pool of one process for each worker, so that a death has one culprit and disturbs nobody else.

    Processes are spawned and not forked: threads of PyTorch do not survive a fork. They end with their parent, however
    that ends.

    Args:
        job: sent to each of them once.
        num_workers: how many.
        threads: of each.
    """

    def __init__(self, job: RunJob, num_workers: int, threads: int | None) -> None:
        self._content, self._threads = dump_job(job), threads
        self._idle = [self._new_pool() for _ in range(num_workers)]
        self._busy: dict[Future[GroupReport], tuple[FrameGroup, ProcessPoolExecutor]] = {}

    @property
    def capacity(self) -> int:
        """One group for each process."""
        return len(self._idle) + len(self._busy)

    def hand_out(self, group: FrameGroup) -> None:
        """Give a group to an idle process."""
        pool = self._idle.pop()
        self._busy[pool.submit(_refine, group)] = (group, pool)

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | WorkerDiedError]]:
        """Wait for any process."""
        done, _ = wait(self._busy, return_when=FIRST_COMPLETED)
        return [self._report(future) for future in done]

    def close(self) -> None:
        """Stop the processes after the groups at hand."""
        for pool in (*self._idle, *(pool for _, pool in self._busy.values())):
            pool.shutdown(wait=True, cancel_futures=True)

    def _report(self, future: Future[GroupReport]) -> tuple[FrameGroup, GroupReport | WorkerDiedError]:
        group, pool = self._busy.pop(future)
        try:
            report: GroupReport | WorkerDiedError = future.result()
        except BrokenProcessPool:
            pool.shutdown(wait=True)
            pool = self._new_pool()
            report = WorkerDiedError("killed, out of memory or crashed")
        self._idle.append(pool)
        return group, report

    def _new_pool(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, initializer=_start, initargs=(self._content, self._threads))


def _start(content: bytes, threads: int | None) -> None:
    # Not read in here: an error would look like a death.
    _process.content = content
    # Ctrl-C reaches the whole group of processes; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    limit_threads(threads)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker was started by nobody"
    parent.join()
    os._exit(1)


def _refine(group: FrameGroup) -> GroupReport:
    if _process.refiner is None:
        _process.refiner = load_job(_process.content)
    return _process.refiner.refine(group)
