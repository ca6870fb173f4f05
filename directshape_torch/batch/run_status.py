"""How far a run is, while it goes on or after it was cut off: reads its files and changes nothing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.batch.journal import FrameRecord, read_journals
from directshape_torch.batch.run_file import RunFile, read_run_file
from directshape_torch.batch.run_lock import LockOwner, read_lock_owner
from directshape_torch.errors import DataFormatError

# Frames of which the rate is: enough for a mean, few enough to follow a change of load.
_RECENT_FRAMES = 200


@dataclass(frozen=True)
class RunStatus:
    """The latest run into a folder.

    Attributes:
        state: "checking", "running", "finished", "stopped", or "killed": the run ended without saying so.
        owner: the process that runs, or None.
        work: who works, from `run.json`.
        num_frames: of the data set.
        num_done: frames done, those of earlier runs included.
        num_resumed: these.
        failed: frames that failed, with the reason.
        frames_per_s: at present, or None where too few have ended.
        seconds_left: at this rate, or None where nobody knows.
        last_frame_at: when a frame last ended, seconds since 1970, or None.
        num_damaged_lines: journal lines that are cut short: being written right now, or by a killed process.
        reason: why a stopped run was stopped, or None.
    """

    state: str
    owner: LockOwner | None
    work: Mapping[str, object]
    num_frames: int
    num_done: int
    num_resumed: int
    failed: Mapping[str, str]
    frames_per_s: float | None
    seconds_left: float | None
    last_frame_at: float | None
    num_damaged_lines: int
    reason: str | None

    @property
    def num_left(self) -> int:
        """Frames that have not ended."""
        return self.num_frames - self.num_done - len(self.failed)


def read_status(out_dir: Path | str, now: float | None = None) -> RunStatus:
    """The status of the latest run into a folder.

    Args:
        out_dir: the output folder.
        now: seconds since 1970; default the clock.

    Raises:
        DataFormatError: no run has been there.
    """
    out_dir = Path(out_dir)
    run = _latest_run(out_dir)
    if run.has_ended:
        return _ended(run)
    status = _going_on(run, out_dir, time.time() if now is None else now)
    # It may have ended meanwhile, and taken its lock and its journals away.
    run = _latest_run(out_dir)
    return _ended(run) if run.has_ended else status


def _latest_run(out_dir: Path) -> RunFile:
    run = read_run_file(out_dir)
    if run is None:
        raise DataFormatError(out_dir, "has no run.json, so no run of 'directshape refine' is or was here")
    return run


def _ended(run: RunFile) -> RunStatus:
    return RunStatus(
        state=run.state,
        owner=None,
        work=run.work,
        num_frames=run.num_frames,
        num_done=run.num_done,
        num_resumed=run.num_resumed,
        failed=run.failed,
        frames_per_s=None,
        seconds_left=None,
        last_frame_at=run.ended_at,
        num_damaged_lines=0,
        reason=run.reason,
    )


def _going_on(run: RunFile, out_dir: Path, now: float) -> RunStatus:
    owner = read_lock_owner(out_dir)
    is_alive = owner is not None and owner.is_alive is not False
    journals = read_journals(out_dir, run.run_id)
    latest = {record.frame_id: record for record in journals.records}
    failed = {frame_id: record.failure for frame_id, record in latest.items() if record.failure is not None}
    num_left = len(run.todo) - len(latest)
    rate = _rate(run, list(latest.values()), now if is_alive else None)
    return RunStatus(
        state=run.state if is_alive else "killed",
        owner=owner if is_alive else None,
        work=run.work,
        num_frames=run.num_frames,
        num_done=run.num_resumed + len(latest) - len(failed),
        num_resumed=run.num_resumed,
        failed=failed,
        frames_per_s=rate,
        seconds_left=num_left / rate if rate and is_alive else None,
        last_frame_at=max((record.finished_at for record in latest.values()), default=None),
        num_damaged_lines=journals.num_damaged,
        reason=None,
    )


def _rate(run: RunFile, records: Sequence[FrameRecord], now: float | None) -> float | None:
    """Frames a second, of the latest ones; a run that is stuck becomes slower with every second that passes."""
    times = sorted(record.finished_at for record in records)[-_RECENT_FRAMES:]
    if not times or run.refining_since is None:
        return None
    is_all = len(times) == len(records)
    start, count = (run.refining_since, len(times)) if is_all else (times[0], len(times) - 1)
    # The frames in work are between two ends, so the mean gap is past before a silence says anything.
    gap = (times[-1] - start) / count
    end = times[-1] if now is None else max(times[-1], now - gap)
    return count / (end - start) if end > start else None


def format_status(status: RunStatus, now: float | None = None, num_failures: int = 10) -> str:
    """A few lines for people."""
    now = time.time() if now is None else now
    lines = [f"run      {_state_text(status)}", _frames_text(status)]
    if status.frames_per_s is not None:
        left = "" if status.seconds_left is None else f", about {_duration(status.seconds_left)} left"
        lines.append(f"rate     {status.frames_per_s:.2f} frames/s{left}")
    if status.last_frame_at is not None and status.state in ("running", "killed"):
        lines.append(f"latest   {_duration(max(0.0, now - status.last_frame_at))} ago")
    for frame_id in sorted(status.failed)[:num_failures]:
        lines.append(f"failed   {frame_id}: {status.failed[frame_id]}")
    if len(status.failed) > num_failures:
        lines.append(f"failed   .. and {len(status.failed) - num_failures} more")
    return "\n".join(lines)


def _frames_text(status: RunStatus) -> str:
    earlier = f" ({status.num_resumed} of them in earlier runs)" if status.num_resumed else ""
    percent = 100 * (1 - status.num_left / status.num_frames) if status.num_frames else 100
    return (
        f"frames   {status.num_done} of {status.num_frames} done{earlier}, {len(status.failed)} failed, "
        f"{status.num_left} left ({percent:.0f} %)"
    )


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
