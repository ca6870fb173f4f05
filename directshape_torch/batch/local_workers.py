"""Worker processes on this machine, each at the end of a pipe of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

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
from directshape_torch.errors import DirectShapeError

# The other end is gone, or went in the middle of something.
_PIPE_ENDED = (EOFError, ConnectionError)


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

    Args:
        job: sent to each of them once.
        num_workers: how many.
        threads: of each.
    """

    def __init__(self, job: RunJob, num_workers: int, threads: int | None) -> None:
        self._content, self._threads = dump_job(job), threads
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
                worker.pipe.send_bytes(self._content)
                worker.has_job = True
            worker.pipe.send(group)
        except _PIPE_ENDED:
            # It is dead, as its pipe tells whoever waits for the report.
            return

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | WorkerDiedError]]:
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
    limit_threads(threads)
    try:
        refiner = _loaded(pipe.recv_bytes())
        while True:
            group = pipe.recv()
            pipe.send(refiner if isinstance(refiner, str) else refiner.refine(group))
    except _PIPE_ENDED:
        return


def _loaded(content: bytes) -> GroupRefiner | str:
    """Or why it cannot be: whatever the code of a user's own classes raises in another process."""
    try:
        return load_job(content)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker was started by nobody"
    parent.join()
    os._exit(1)
