"""Workers on a Ray cluster: each group is one task, which Ray places, watches and retries (extra `ray`).

All machines must see the input and the output folder under the same paths, and have the same package installed.
"""

from __future__ import annotations

import os
import uuid
from typing import Any

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.group_refinement import (
    GroupRefiner,
    GroupReport,
    RunJob,
    dump_job,
    limit_threads,
    load_job,
)
from directshape_torch.batch.options import WorkerOptions
from directshape_torch.batch.workers import WorkerDiedError
from directshape_torch.errors import DirectShapeError, MissingDependencyError

# A processor that has its next group already does not wait for the driver, which may be far away.
_GROUPS_PER_WORKER = 2
_REPORTS = "RAY_USAGE_STATS_ENABLED"

# Of this worker process: it keeps one job, its latest.
_refiners: dict[str, GroupRefiner] = {}


class RayWorkers:
    """The cluster at an address, or one of this machine alone.

    Args:
        job: put into the cluster's object store once.
        options: address, number of workers, threads of each, retries.

    Raises:
        MissingDependencyError: Ray is not installed.
        DirectShapeError: no cluster answers at the address.
    """

    def __init__(self, job: RunJob, options: WorkerOptions) -> None:
        self._ray = _import_ray()
        self._threads = options.threads_per_worker or 1
        self._retries = options.retries
        self._starts_cluster = not self._ray.is_initialized()
        if self._starts_cluster:
            _connect(self._ray, options)
        num_cpus = int(self._ray.cluster_resources().get("CPU", 1))
        self.num_workers = options.workers or max(1, num_cpus // self._threads)
        # Ray places all tasks that fit; a cluster of this machine has just the cores of its workers.
        self._is_limited = options.workers is not None and not (self._starts_cluster and options.ray == "local")
        needs_gpu = job.refiner.prior.origin.device.type == "cuda"
        remote = self._ray.remote(
            num_cpus=self._threads, num_gpus=1 if needs_gpu else 0, max_retries=options.retries, retry_exceptions=False
        )
        self._refine = remote(refine_in_ray)
        self._job, self._run_id = self._ray.put(dump_job(job)), uuid.uuid4().hex
        self._busy: dict[Any, FrameGroup] = {}

    @property
    def capacity(self) -> int:
        """As many groups as keep all workers busy; on a cluster no more than the workers that were asked for."""
        return self.num_workers if self._is_limited else _GROUPS_PER_WORKER * self.num_workers

    def hand_out(self, group: FrameGroup) -> None:
        """Submit a task."""
        self._busy[self._refine.remote(self._job, self._run_id, self._threads, group)] = group

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | WorkerDiedError]]:
        """Wait for any task."""
        done, _ = self._ray.wait(list(self._busy), num_returns=1)
        return [(self._busy.pop(task), self._result(task)) for task in done]

    def close(self) -> None:
        """Give up the tasks that are left, and end a cluster that this run has started."""
        for task in self._busy:
            self._ray.cancel(task)
        if self._busy:
            self._ray.wait(list(self._busy), num_returns=len(self._busy), timeout=None)
        if self._starts_cluster:
            self._ray.shutdown()

    def _result(self, task: Any) -> GroupReport | WorkerDiedError:
        errors = self._ray.exceptions
        try:
            report: GroupReport = self._ray.get(task)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError) as error:
            return WorkerDiedError(f"Ray: {str(error).splitlines()[0]}", num_tries=self._retries + 1)
        except errors.RayError as error:
            raise DirectShapeError(f"Ray could not run a group of frames: {error}") from error
        return report


def refine_in_ray(content: bytes, run_id: str, threads: int, group: FrameGroup) -> GroupReport:
    """One task; a worker process that has had one of this run keeps what it has read."""
    if run_id not in _refiners:
        _refiners.clear()
        limit_threads(threads)
        _refiners[run_id] = load_job(content)
    return _refiners[run_id].refine(group)


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError("ray", "ray", "refining on a cluster") from error
    return ray


def _connect(ray: Any, options: WorkerOptions) -> None:
    # Ray would report its use to its makers; who starts a cluster himself has decided that himself.
    is_decided = _REPORTS in os.environ
    os.environ.setdefault(_REPORTS, "0")
    quiet = {"log_to_driver": False, "logging_level": "warning"}
    try:
        if options.ray == "local":
            cpus = None if options.workers is None else options.workers * (options.threads_per_worker or 1)
            ray.init(address="local", num_cpus=cpus, include_dashboard=False, **quiet)
        else:
            ray.init(address=options.ray, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise DirectShapeError(
            f"no Ray cluster answers at {options.ray!r}: {error}; is it started, and if it asks for a token, is "
            "RAY_AUTH_MODE=token set here too?"
        ) from error
    finally:
        if not is_decided:
            del os.environ[_REPORTS]
