"""This module refines the groups of a run on a cluster of Ray, after it has checked that every node can do so."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import torch

from directshape_torch.batch.engines import pickled
from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.group_refinement import GroupReport, RunJob, refine_group, set_threads
from directshape_torch.batch.run_summary import versions
from directshape_torch.errors import DataFormatError, DirectShapeError, InputError, MissingDependencyError
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.run_manifest import hash_file

# Ray itself tries for minutes, and then ends the process.
_ANSWER_S = 5.0
# A node that imports PyTorch for the first time from a network disk is slow.
_CHECK_S = 300.0
# These errors of Ray say that a process, or what it had made, is gone.
_DEATHS = "WorkerCrashedError", "OutOfMemoryError", "NodeDiedError", "LocalRayletDiedError", "ObjectLostError"


@dataclass(frozen=True)
class _Offer:
    """An `_Offer` is a job with what a node needs for it."""

    job: bytes
    versions: Mapping[str, str]  # of Python and of the packages that compute
    folder: str  # folder from which relative paths count
    inputs: Mapping[str, str]  # hashes of the files of the first frame, by path
    mark: str  # a file in the output folder, which contains its own name


class RayEngine:
    """A `RayEngine` hands groups to the nodes of a cluster, each of which must have the package and see the same files.

    The body ends the job on the cluster.

    Args:
        job: job whose paths all nodes see.
        address: address "HOST:PORT" of the cluster, to which this machine belongs.

    Raises:
        MissingDependencyError: Ray is not installed.
        InputError: the address is wrong or does not answer, the device is no CPU, or a node cannot do the job.
    """

    def __init__(self, job: RunJob, address: str) -> None:
        check_cluster(address, job.refiner.prior.origin.device)
        try:
            import ray
        except ImportError as error:
            raise MissingDependencyError("ray", "cluster", "a run on a cluster") from error
        self._ray, threads = ray, job.options.threads_per_worker or 1
        self._mark = job.out_dir.absolute() / f".{os.urandom(6).hex()}.tmp"
        offer = _offer(job, self._mark)
        before = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, RuntimeError, ValueError) as error:
            found = f"{address} ({_last_line(error)})"
            raise InputError("ray", "the address of a cluster that this machine belongs to", found) from error
        finally:
            # Ray lets SIGTERM end the process without its last words.
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, before)
        try:
            self._offer = ray.put(offer)
            # Ray itself would repeat processes that are killed for memory for ever.
            self._task = ray.remote(num_cpus=threads, max_retries=0)(_refine_there)
            nodes = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
            self.workers = sum(int(node["Resources"]["CPU"]) // threads for node in nodes)
            if not self.workers:
                raise InputError("threads", "at most the processors of a node of the cluster", str(threads))
            write_text(self._mark, self._mark.name)
            self._check(nodes)
        except BaseException:
            self.__exit__()
            raise

    def submit(self, group: FrameGroup) -> Future[GroupReport]:
        # A list keeps Ray from loading the offer for each group.
        future: Future[GroupReport] = self._task.remote([self._offer], group).future()
        return future

    def report(self, future: Future[GroupReport]) -> GroupReport | None:
        # Other runs into the folder remove temporary files that nobody has touched for an hour.
        with suppress(OSError):
            os.utime(self._mark)
        try:
            return future.result()
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, DirectShapeError):
                raise error.cause from None
            raise DirectShapeError(_last_line(error)) from error
        except self._ray.exceptions.RayError as error:
            if isinstance(error, tuple(getattr(self._ray.exceptions, name) for name in _DEATHS)):
                return None
            raise DirectShapeError(f"the cluster failed: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()
        self._mark.unlink(missing_ok=True)

    def _check(self, nodes: list[dict[str, Any]]) -> None:
        """Raise `InputError` with the first node that cannot do the job."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        asked = []
        for node in nodes:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            asked.append(self._ray.remote(num_cpus=0, scheduling_strategy=there)(_problem_there))
        answers = [task.remote([self._offer]) for task in asked]
        for node, answer in zip(nodes, answers, strict=True):
            try:
                problem = self._ray.get(answer, timeout=_CHECK_S)
            except self._ray.exceptions.RayError as error:
                problem = _last_line(error)
            if problem is not None:
                name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
                raise InputError("ray", "nodes that can do the job", f"node {name}: {problem}")


def check_cluster(address: str, device: torch.device) -> None:
    """Raise `InputError` unless the device is a CPU and something answers at the address "HOST:PORT"."""
    if device.type != "cpu":
        raise InputError("ray", "a refiner on the CPU", str(device), "leave out --device")
    host, _, port = address.rpartition(":")
    if "/" in address or not host or not port.isdecimal():
        raise InputError("ray", "an address HOST:PORT", repr(address))
    try:
        socket.create_connection((host, int(port)), _ANSWER_S).close()
    except (OSError, OverflowError) as error:
        cure = "start one with: ray start --head"
        raise InputError("ray", "the address of a running cluster", f"{address} ({error})", cure) from error


def _offer(job: RunJob, mark: Path) -> _Offer:
    files: dict[str, Path] = {}
    # A file that is damaged or missing here too is reported when its frame is refined.
    with suppress(DirectShapeError, OSError):
        files = job.dataset.input_files(job.dataset.frame_ids[0])
    inputs = {str(path): hash_file(path) for path in files.values() if path.is_file()}
    return _Offer(pickled(job), versions(), os.getcwd(), inputs, str(mark))


def _problem_there(offer: list[Any]) -> str | None:
    """Why this node cannot do a job, or None."""
    return _loaded(offer[0])[1]


def _refine_there(offer: list[Any], group: FrameGroup) -> GroupReport:
    """Refine a group on a node, which may have joined the cluster after the run had started."""
    job, problem = _loaded(offer[0])
    if job is None:
        raise DirectShapeError(f"node {socket.gethostname()}: {problem}")
    return refine_group(job, group)


@lru_cache(maxsize=1)
def _loaded(reference: Any) -> tuple[RunJob | None, str | None]:
    """The job of an offer, or why this node cannot do it; processes of Ray serve one job."""
    import ray

    offer: _Offer = ray.get(reference)
    found = versions()
    for package in sorted({*offer.versions, *found}):
        wanted, got = (each.get(package, "absent") for each in (offer.versions, found))
        if wanted != got:
            return None, f"{package} is {got} there and {wanted} here"
    if Path(offer.folder).is_dir():
        os.chdir(offer.folder)
    try:
        if Path(offer.mark).read_text() != Path(offer.mark).name or not os.access(Path(offer.mark).parent, os.W_OK):
            return None, f"it cannot write to {Path(offer.mark).parent}"
        for path, sha256 in offer.inputs.items():
            if hash_file(path) != sha256:
                return None, f"{path} is another file there"
    except (DataFormatError, OSError) as error:
        return None, f"it does not see the files of the run: {error}"
    try:
        job: RunJob = pickle.loads(offer.job)
    # A user's own classes may raise any error when they are loaded on another machine.
    except Exception as error:
        return None, f"it cannot read the job: {type(error).__name__}: {error}"
    set_threads(job.options.threads_per_worker)
    return job, None


def _last_line(error: Exception) -> str:
    """What an error of Ray says, without the way there."""
    return (str(error).strip() or type(error).__name__).splitlines()[-1]
