"""This module reads the progress of a run from the files in its folder, at any time, and changes nothing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.run_folder import done_frames, failure_path, read_failure, shapes_path, summary_path
from directshape_torch.io.run_manifest import read_manifest

# The rate is measured over this many frames: enough for a mean, few enough to follow a change of load.
_RECENT_FRAMES = 200
_SHOWN_FAILURES = 10


@dataclass(frozen=True)
class RunStatus:
    """A `RunStatus` says how many frames of a folder have ended."""

    num_frames: int  # of the data set
    num_done: int  # frames done, including frames of earlier runs
    num_earlier: int  # frames done before the latest run began or after it ended
    failed: Mapping[str, str]  # frames that failed, with the reason
    frames_per_s: float | None  # current rate, or None if no frame of this run has ended, or all have
    seconds_left: float | None  # at the current rate, or None if it is not known
    last_frame_at: float | None  # time of the latest end of a frame, seconds since 1970, or None

    @property
    def num_left(self) -> int:
        """Number of frames that have not ended."""
        return self.num_frames - self.num_done - len(self.failed)


def read_status(out_dir: Path | str, now: float | None = None) -> RunStatus:
    """The status of the runs into a folder at a time (seconds since 1970), by default now.

    The summary is written when a run begins, so frames with a later file are of this run. A frame that gets further
    outputs counts as done all the while.
    """
    out_dir, path = Path(out_dir), summary_path(out_dir)
    manifest = read_manifest(path)
    if manifest is None:
        raise DataFormatError(path, "is missing, so no run of 'directshape refine' is or was here")
    began_at, frames = path.stat().st_mtime, set(manifest.frames)
    ended_at = {}
    for name in frames.intersection(done_frames(out_dir)):
        with suppress(FileNotFoundError):  # A run that begins afresh has just removed it.
            ended_at[name] = shapes_path(out_dir, name).stat().st_mtime
    recent = sorted(at for at in ended_at.values() if at >= began_at)
    failures = [name for name in sorted(frames.difference(ended_at)) if failure_path(out_dir, name).is_file()]
    failed = {name: read_failure(out_dir, name) for name in failures}
    num_left = len(frames) - len(ended_at) - len(failed)
    rate = _rate(began_at, recent, time.time() if now is None else now) if num_left else None
    return RunStatus(
        num_frames=len(frames),
        num_done=len(ended_at),
        num_earlier=len(ended_at) - len(recent),
        failed=failed,
        frames_per_s=rate,
        seconds_left=num_left / rate if rate else None,
        last_frame_at=max(ended_at.values(), default=None),
    )


def _rate(start: float, all_times: Sequence[float], now: float) -> float | None:
    """Frames per second over the latest frames; for a run that is stuck it decreases with time."""
    times = all_times[-_RECENT_FRAMES:]
    if not times:
        return None
    start, count = (start, len(times)) if len(times) == len(all_times) else (times[0], len(times) - 1)
    # Frames take about the mean gap between two ends, so only silence longer than this lowers the rate.
    gap = (times[-1] - start) / count
    end = max(times[-1], now - gap)
    return count / (end - start) if end > start else None


def format_status(status: RunStatus, now: float | None = None) -> str:
    """The status as a few lines of text."""
    now = time.time() if now is None else now
    earlier = f" ({status.num_earlier} of them earlier)" if status.num_left and status.num_earlier else ""
    percent = 100 * (1 - status.num_left / status.num_frames) if status.num_frames else 100
    lines = [
        f"frames   {status.num_done} of {status.num_frames} done{earlier}, {len(status.failed)} failed, "
        f"{status.num_left} left ({percent:.0f} %)",
    ]
    if status.frames_per_s is not None and status.seconds_left is not None:
        lines.append(f"rate     {status.frames_per_s:.2f} frames/s, about {_duration(status.seconds_left)} left")
    if status.last_frame_at is not None and status.num_left:
        ago = _duration(max(0.0, now - status.last_frame_at))
        lines.append(f"latest   {ago} ago; if no run is at work, the same command again goes on")
    lines += [f"failed   {name}: {why}" for name, why in sorted(status.failed.items())[:_SHOWN_FAILURES]]
    if len(status.failed) > _SHOWN_FAILURES:
        lines.append(f"failed   .. and {len(status.failed) - _SHOWN_FAILURES} more")
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    """Hours, minutes and seconds, as in 1:02:03."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
