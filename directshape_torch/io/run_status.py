"""This module reads the progress of a run from its log, during the run or after its end, and changes nothing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.run_log import read_log

# The rate is measured over this many frames: enough for a mean, few enough to follow a change of load.
_RECENT_FRAMES = 200
_SHOWN_FAILURES = 10


@dataclass(frozen=True)
class RunStatus:
    """A `RunStatus` describes the latest run into a folder."""

    state: str  # "checking", "running", "finished", "stopped", or "killed" if the run ended without an entry in its log
    owner: str | None  # the running process in words, or None
    work: Mapping[str, object]  # processes and threads, see `RunBeginning`
    num_frames: int  # of the data set
    num_done: int  # frames done, including frames of earlier runs
    num_resumed: int  # frames done by earlier runs
    failed: Mapping[str, str]  # frames that failed, with the reason
    frames_per_s: float | None  # current rate, or None if too few frames have ended
    seconds_left: float | None  # at the current rate, or None if it is not known
    last_frame_at: float | None  # time of the last end of a frame, seconds since 1970, or None
    reason: str | None  # why a stopped run was stopped, or None

    @property
    def num_left(self) -> int:
        """Number of frames that have not ended."""
        return self.num_frames - self.num_done - len(self.failed)


def read_status(out_dir: Path | str, now: float | None = None) -> RunStatus:
    """The status of the latest run into a folder at a time (seconds since 1970), by default now."""
    log = read_log(Path(out_dir))
    if log is None:
        raise DataFormatError(out_dir, "has no run.jsonl, so no run of 'directshape refine' is or was here")
    is_alive = log[0].is_alive is not False
    # The run may have ended after its log was read.
    run, events = log if is_alive else read_log(Path(out_dir)) or log
    frames = {event.frame: event for event in events if event.frame is not None}
    checked = next((event for event in events if event.resumed is not None), None)
    end = next((event for event in events if event.end is not None), None)
    is_alive = is_alive and end is None
    resumed = (checked and checked.resumed) or 0
    failed = {name: event.failure for name, event in frames.items() if event.failure is not None}
    times = sorted(event.at for event in frames.values())
    rate = None
    if end is None and checked is not None:
        rate = _rate(checked.at, times, (time.time() if now is None else now) if is_alive else None)
    num_left = run.num_frames - resumed - len(frames)
    going = "checking" if checked is None else "running"
    return RunStatus(
        state=(end.end if end else None) or (going if is_alive else "killed"),
        owner=run.owner if is_alive else None,
        work=run.work,
        num_frames=run.num_frames,
        num_done=resumed + len(frames) - len(failed) if end is None else end.done,
        num_resumed=resumed,
        failed=failed if end is None else end.failed,
        frames_per_s=rate,
        seconds_left=num_left / rate if rate and is_alive else None,
        last_frame_at=max(times, default=None) if end is None else end.at,
        reason=None if end is None else end.reason,
    )


def _rate(start: float, all_times: Sequence[float], now: float | None) -> float | None:
    """Frames per second over the latest frames; for a run that is stuck it decreases with time."""
    times = all_times[-_RECENT_FRAMES:]
    if not times:
        return None
    start, count = (start, len(times)) if len(times) == len(all_times) else (times[0], len(times) - 1)
    # Frames take about the mean gap between two ends, so only silence longer than this lowers the rate.
    gap = (times[-1] - start) / count
    end = times[-1] if now is None else max(times[-1], now - gap)
    return count / (end - start) if end > start else None


def format_status(status: RunStatus, now: float | None = None) -> str:
    """The status as a few lines of text."""
    now = time.time() if now is None else now
    earlier = f" ({status.num_resumed} of them in earlier runs)" if status.num_resumed else ""
    percent = 100 * (1 - status.num_left / status.num_frames) if status.num_frames else 100
    lines = [
        f"run      {_state_text(status)}",
        f"frames   {status.num_done} of {status.num_frames} done{earlier}, {len(status.failed)} failed, "
        f"{status.num_left} left ({percent:.0f} %)",
    ]
    if status.frames_per_s is not None:
        left = "" if status.seconds_left is None else f", about {_duration(status.seconds_left)} left"
        lines.append(f"rate     {status.frames_per_s:.2f} frames/s{left}")
    if status.last_frame_at is not None and status.state in ("running", "killed"):
        lines.append(f"latest   {_duration(max(0.0, now - status.last_frame_at))} ago")
    lines += [f"failed   {name}: {why}" for name, why in sorted(status.failed.items())[:_SHOWN_FAILURES]]
    if len(status.failed) > _SHOWN_FAILURES:
        lines.append(f"failed   .. and {len(status.failed) - _SHOWN_FAILURES} more")
    return "\n".join(lines)


def _state_text(status: RunStatus) -> str:
    work = status.work
    who = f"{work.get('workers') or 'all'} workers with {work.get('threads')} threads, {work.get('where')}"
    texts = {
        "checking": f"checking what earlier runs left ({status.owner})",
        "running": f"running ({status.owner}; {who})",
        "finished": "finished",
        "stopped": f"stopped: {status.reason}; the same command again goes on",
        "killed": "ended without saying so, probably killed; the same command again goes on",
    }
    return texts[status.state]


def _duration(seconds: float) -> str:
    """Hours, minutes and seconds, as in 1:02:03."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
