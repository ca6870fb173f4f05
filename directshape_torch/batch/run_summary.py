"""This module summarises a run over a data set: frames, cars, warnings and times of the calls."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_json
from directshape_torch.files.read_files import read_json
from directshape_torch.io.run_folder import FrameEntry
from directshape_torch.status import Status, counted

TIMINGS = "timings.json"
TIMINGS_SCHEMA_VERSION = 2
_CPU = torch.device("cpu")
# A warning names at most this many cars without a mask.
_NAMED = 3
_PACKAGES = ("directshape_torch", "torch", "numpy", "opencv-python-headless", "scipy", "numba")
# The last digits of a result depend on these entries of `timings.json`.
_DIGITS = ("versions", "threads", "batch_frames", "device")


@dataclass(frozen=True)
class CallTiming:
    """A `CallTiming` is one call of the refiner, without reading and writing."""

    frame_ids: tuple[str, ...]  # frames of the call
    num_cars: int  # number of its cars
    refine_s: float  # duration in seconds


@dataclass
class RunTimings:
    """A `RunTimings` has all calls of a run, in order."""

    device: torch.device = _CPU  # device of the refiner
    calls: list[CallTiming] = field(default_factory=list)  # one entry for each call
    workers: int = 1  # parallel processes
    threads: int = field(default_factory=torch.get_num_threads)  # of each process
    batch_frames: int = 1  # frames in a call
    cpu_s: float = 0.0  # processor time for the frames, in all workers, including reading and writing
    wall_s: float = 0.0  # seconds from the first frame to the last, including reading and writing
    peak_mb: float | None = None  # the largest resident memory of any of these processes, MB, if the system reports it
    peak_device_mb: float | None = None  # the largest memory of tensors on a graphics card, MB

    @contextmanager
    def measure(self, frame_ids: Sequence[str], num_cars: int) -> Iterator[None]:
        """Measure the body as one call; wait for the device before and after."""
        _wait_for(self.device)
        start = time.perf_counter()
        yield
        _wait_for(self.device)
        seconds = time.perf_counter() - start
        self.calls.append(CallTiming(tuple(frame_ids), num_cars, seconds))

    def add(self, other: RunTimings) -> None:
        """Add the timings of another process."""
        self.calls += other.calls
        self.cpu_s += other.cpu_s
        self.peak_mb = _larger(self.peak_mb, other.peak_mb)
        self.peak_device_mb = _larger(self.peak_device_mb, other.peak_device_mb)

    @property
    def refining_share(self) -> float:
        """The share of the workers' time in calls of the refiner; reading, ground planes and writing have the rest."""
        return min(sum(call.refine_s for call in self.calls) / (self.workers * self.wall_s), 1.0)

    @property
    def num_frames(self) -> int:
        return sum(len(call.frame_ids) for call in self.calls)

    def ms_per(self, number: int) -> float | None:
        """Mean milliseconds of all calls per car or frame, given their number; None for 0."""
        return 1000 * sum(call.refine_s for call in self.calls) / number if number else None

    @property
    def ms_per_car(self) -> float | None:
        return self.ms_per(sum(call.num_cars for call in self.calls))

    @property
    def ms_per_frame(self) -> float | None:
        return self.ms_per(self.num_frames)


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that compute."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def digit_warnings(out_dir: Path, timings: RunTimings) -> list[str]:
    """Warnings about differences from the previous run that may change the last digits of further results."""
    before, now = {}, _content(timings)
    # Results do not need this file, so one that is missing or damaged is no reason to stop.
    with suppress(DataFormatError):
        before = read_json(out_dir / TIMINGS)
    return [
        f"{name}: {before[name]} in the previous run, {now[name]} now; the last digits of results may differ"
        for name in _DIGITS
        if isinstance(before, dict) and before.get(name, now[name]) != now[name]
    ]


def write_timings(out_dir: Path, timings: RunTimings) -> None:
    """Write `timings.json` (schema 2), a separate file, so that all other files are the same in every run."""
    write_json(out_dir / TIMINGS, _content(timings))


def _content(timings: RunTimings) -> dict[str, Any]:
    return {
        "schema_version": TIMINGS_SCHEMA_VERSION,
        "versions": versions(),
        "device": device_name(timings.device),
        "workers": timings.workers,
        "threads": timings.threads,
        "batch_frames": timings.batch_frames,
        "peak_memory_mb": timings.peak_mb,
        "peak_device_memory_mb": timings.peak_device_mb,
        "wall_s": _rounded(timings.wall_s),
        "cpu_s": _rounded(timings.cpu_s),
        "ms_per_car": _rounded(timings.ms_per_car),
        "ms_per_frame": _rounded(timings.ms_per_frame),
        "calls": [
            {"frames": list(call.frame_ids), "cars": call.num_cars, "refine_ms": _rounded(1000 * call.refine_s)}
            for call in timings.calls
        ],
    }


def device_name(device: torch.device) -> str:
    """The name of the graphics card, or "cpu"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def peak_memory_mb() -> float | None:
    """The largest resident memory of the process so far, MB, or None if the system does not report it."""
    status = Path("/proc/self/status")
    if status.exists():
        # The file contains the program's name, which may be cut within a character.
        lines = status.read_text(errors="replace").splitlines()
        # `getrusage` is not used here, because a new process starts there with the peak of its parent.
        kib = next((line.split()[1] for line in lines if line.startswith("VmHWM:")), None)
        if kib is not None:
            return round(int(kib) / 2**10, 1)
    try:
        import resource
    except ImportError:  # only Unix has it
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts in bytes, other systems in KiB.
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def peak_device_memory_mb(device: torch.device) -> float | None:
    """The largest memory of tensors on a graphics card so far, MB, or None on the CPU."""
    return round(torch.cuda.max_memory_allocated(device) / 2**20, 1) if device.type == "cuda" else None


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _larger(*sizes: float | None) -> float | None:
    return max((size for size in sizes if size is not None), default=None)


def _rounded(number: float | None) -> float | None:
    return None if number is None else round(number, 3)


@dataclass(frozen=True)
class RunSummary:
    """A `RunSummary` is the outcome of `refine_dataset`."""

    frames: Mapping[str, FrameEntry]  # how each frame of the data set ended
    resumed: tuple[str, ...]  # frames that an earlier run had finished
    failed: Mapping[str, str]  # frames that could not be refined, with the reason
    warnings: tuple[str, ...]  # likely mistakes that did not cause a failure
    timings: RunTimings  # of the calls of this run

    @property
    def num_cars(self) -> int:
        """Number of cars of all frames that did not fail, refined or not."""
        return sum(entry.get("cars", 0) for entry in self.frames.values())

    @property
    def statuses(self) -> dict[str, int]:
        """Number of cars of each status, in the order of `Status`."""
        return count_statuses(self.frames)

    @property
    def exit_code(self) -> int:
        """0 if every frame is done, 1 if some failed."""
        return int(bool(self.failed))


def count_statuses(frames: Mapping[str, FrameEntry]) -> dict[str, int]:
    """Number of cars of each status that occurs in the entries of frames."""
    counts: Counter[str] = Counter()
    for entry in frames.values():
        counts.update(entry.get("statuses", {}))
    return {status.name: counts[status.name] for status in Status if counts[status.name]}


def find_warnings(frames: Mapping[str, FrameEntry], classes: Sequence[str]) -> tuple[str, ...]:
    """Warnings about results that suggest wrong inputs of a run.

    Examples:
        >>> find_warnings({"000001": {"lines": 2, "cars": 0, "statuses": {}}}, ["Car"])
        ('none of the 2 input lines is of class Car with a 3D box: nothing was refined',)
    """
    done = [entry for entry in frames.values() if "reason" not in entry]
    num_lines, num_cars = sum(entry["lines"] for entry in done), sum(entry["cars"] for entry in done)
    statuses = count_statuses(frames)
    refined = sum(count for name, count in statuses.items() if Status[name].is_refined)
    no_mask, no_camera = statuses.get("no_mask", 0), statuses.get("behind_camera", 0)
    found = []
    if num_lines and not num_cars:
        found.append(
            f"none of the {num_lines} input lines is of class {', '.join(classes)} with a 3D box: nothing was refined"
        )
    elif num_cars and no_mask == num_cars:
        checks = "check masks and their frame numbers"
        found.append(f"none of the {num_cars} cars has a mask in the left image: {_reasons(frames) or checks}")
    elif num_cars and no_camera == num_cars:
        found.append(f"all {num_cars} initial boxes lie behind or at the camera: check the frame of the detections")
    elif num_cars and 2 * refined < num_cars:
        found.append(f"only {refined} of {num_cars} cars were refined: see the statuses")
    if 0 < no_mask < num_cars:
        found.append(f"{no_mask} of {num_cars} cars have no mask in the left image: {_reasons(frames)}")
    guessed = sum(entry.get("ground_source") == "camera_height" for entry in done)
    if num_cars and guessed:
        found.append(f"the ground of {guessed} of {len(done)} frames is only the camera height's: give plane files")
    return tuple(found)


def _reasons(frames: Mapping[str, FrameEntry]) -> str:
    """Why the first cars have no mask."""
    every = [
        f"line {line} of {frame_id}: {reason}"
        for frame_id, entry in frames.items()
        for line, reason in entry.get("no_mask", {}).items()
    ]
    more = f"; {len(every) - _NAMED} more" if len(every) > _NAMED else ""
    return "; ".join(every[:_NAMED]) + more


def format_summary(summary: RunSummary) -> str:
    """The text that the program prints at the end of a run."""
    done, timings = len(summary.frames) - len(summary.failed), summary.timings
    earlier = f", {len(summary.resumed)} of them in an earlier run" if summary.resumed else ""
    lines = [
        f"frames   {done} done{earlier}, {len(summary.failed)} failed",
        f"cars     {summary.num_cars}: {counted(summary.statuses)}",
    ]
    if timings.ms_per_frame is not None:
        per_car = "" if timings.ms_per_car is None else f"{timings.ms_per_car:.0f} ms per car, "
        where = device_name(timings.device)
        lines.append(f"time     {per_car}{timings.ms_per_frame:.0f} ms per frame (refinement only, {where})")
    if timings.num_frames and timings.wall_s:
        rate, share = timings.num_frames / timings.wall_s, timings.refining_share
        by = f"{timings.workers} worker{'s' if timings.workers > 1 else ''}"
        lines.append(f"rate     {rate:.2f} frames a second by {by}, of whose time {share:.0%} is refinement")
    host, device = timings.peak_mb or peak_memory_mb(), timings.peak_device_mb
    each = " a worker" if timings.workers > 1 else ""
    sizes = [f"{host:.0f} MB{each}"] if host is not None else []
    sizes += [f"{device:.0f} MB on the device"] if device is not None else []
    return "\n".join([*lines, f"memory   {', '.join(sizes)} at most"] if sizes else lines)
