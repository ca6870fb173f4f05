"""How a run over a data set ended, over all of its frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from directshape_torch.batch.timing import RunTimings, device_name, peak_memory_mb
from directshape_torch.status import Status


@dataclass(frozen=True)
class RunSummary:
    """Outcome of `refine_dataset`.

    Attributes:
        frames: for each frame of the data set its entry of `summary.json`.
        resumed: frames that an earlier run had finished.
        failed: frames that could not be refined, with the reason.
        warnings: things that look wrong though nothing failed.
        timings: of the calls of this run.
    """

    frames: Mapping[str, Mapping[str, Any]]
    resumed: tuple[str, ...]
    failed: Mapping[str, str]
    warnings: tuple[str, ...]
    timings: RunTimings

    @property
    def num_cars(self) -> int:
        """Cars of all frames that did not fail, refined or not."""
        return sum(entry.get("cars", 0) for entry in self.frames.values() if entry["state"] == "done")

    @property
    def statuses(self) -> dict[str, int]:
        """Number of cars of each status, in the order of `Status`."""
        return count_statuses(self.frames)

    @property
    def exit_code(self) -> int:
        """0 when every frame is done, 1 when some failed."""
        return 1 if self.failed else 0


def count_statuses(frames: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Number of cars of each status that occurs, over the entries of `summary.json`."""
    counts: Counter[str] = Counter()
    for entry in frames.values():
        counts.update(entry.get("statuses", {}))
    return {status.name: counts[status.name] for status in Status if counts[status.name]}


def find_warnings(frames: Mapping[str, Mapping[str, Any]], classes: Sequence[str]) -> tuple[str, ...]:
    """Signs that a run was given the wrong things.

    Examples:
        >>> find_warnings({"000001": {"state": "done", "lines": 2, "cars": 0, "statuses": {}}}, ["Car"])
        ('none of the 2 input lines is of class Car with a 3D box: nothing was refined',)
    """
    done = [entry for entry in frames.values() if entry["state"] == "done"]
    num_lines, num_cars = (sum(entry.get(name, 0) for entry in done) for name in ("lines", "cars"))
    statuses = count_statuses(frames)
    refined = sum(count for name, count in statuses.items() if Status[name].is_refined)
    no_mask, no_camera = statuses.get("no_mask", 0), statuses.get("behind_camera", 0)
    found = []
    if num_lines and not num_cars:
        found.append(
            f"none of the {num_lines} input lines is of class {', '.join(classes)} with a 3D box: nothing was refined"
        )
    elif num_cars and no_mask == num_cars:
        found.append(f"none of the {num_cars} cars has a mask in either image: check the masks and their frame numbers")
    elif num_cars and no_camera == num_cars:
        found.append(f"all {num_cars} initial boxes lie behind or at the camera: check the frame of the detections")
    elif num_cars and 2 * refined < num_cars:
        found.append(f"only {refined} of {num_cars} cars were refined: see the statuses")
    if num_cars > no_mask and not sum(entry.get("masks_left", 0) for entry in done):
        found.append("no car has a mask in the left image: check the masks of that side")
    guessed = sum(entry.get("ground_source") == "camera_height" for entry in done)
    if num_cars and guessed:
        found.append(f"the ground of {guessed} of {len(done)} frames is only the camera height's: give plane files")
    return tuple(found)


def format_summary(summary: RunSummary) -> str:
    """What the program prints at the end of a run."""
    done = len(summary.frames) - len(summary.failed)
    earlier = f", {len(summary.resumed)} of them in an earlier run" if summary.resumed else ""
    statuses = ", ".join(f"{name} {count}" for name, count in summary.statuses.items()) or "none"
    lines = [
        f"frames   {done} done{earlier}, {len(summary.failed)} failed",
        f"cars     {summary.num_cars}: {statuses}",
    ]
    return "\n".join([*lines, *_timing_lines(summary.timings)])


def _timing_lines(timings: RunTimings) -> list[str]:
    lines = []
    if timings.ms_per_frame is not None:
        per_car = "" if timings.ms_per_car is None else f"{timings.ms_per_car:.0f} ms per car, "
        where = device_name(timings.device)
        # It is part of the calls in which it happens, and of a short run most of the time.
        compiling = " with compiling or loading code" if any(call.compiled for call in timings.calls) else ""
        lines.append(f"time     {per_car}{timings.ms_per_frame:.0f} ms per frame (refinement only{compiling}, {where})")
    if timings.workers > 1 and timings.wall_s:
        rate = timings.num_frames / timings.wall_s
        lines.append(f"rate     {rate:.2f} frames a second by {timings.workers} workers (everything included)")
    host, device = timings.peak_mb or peak_memory_mb(), timings.peak_device_mb
    each = " a worker" if timings.workers > 1 else ""
    sizes = [f"{host:.0f} MB{each}"] if host is not None else []
    sizes += [f"{device:.0f} MB on the device"] if device is not None else []
    return [*lines, f"memory   {', '.join(sizes)} at most"] if sizes else lines
