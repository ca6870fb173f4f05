"""`run.json`: how the latest run into a folder was made and how far it came; the results themselves do not need it.

While the run goes on it names the frames to do, of which the journals tell those that have ended.
"""

from __future__ import annotations

import importlib.metadata
import platform
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.atomic_files import write_json
from directshape_torch.files.read_files import read_json
from directshape_torch.files.schema import record_of

RUN_SCHEMA_VERSION = 1
RunState = Literal["checking", "running", "finished", "stopped"]
_PACKAGES = ("directshape_torch", "torch", "numpy", "opencv-python-headless", "scipy")
# What the last digits of a result depend on.
_DIGITS = ("threads", "batch_frames", "device")


@dataclass(frozen=True)
class RunFile:
    """One run, from its beginning to its end.

    Attributes:
        run_id: names its journals.
        state: "checking" what earlier runs left, "running", "finished" (also with failed frames) or "stopped" by the
            user or an error.
        started_at: seconds since 1970, like the other times.
        refining_since: when the first frame was begun, or None.
        ended_at: or None.
        versions: of Python and of the packages that compute.
        machine: operating system and processor.
        settings: `config` and `sha256` of the summary, nested.
        work: who worked: "where" ("this process", "processes" or the address of a Ray cluster), "workers", "threads" of
            each, "device", "batch_frames", "outputs".
        num_frames: of the data set.
        num_resumed: of these, finished by earlier runs.
        todo: the others, while the run goes on.
        num_done: frames done at the end, those of earlier runs included.
        failed: reasons at the end.
        reason: why it was stopped, or None.
    """

    run_id: str
    state: RunState
    started_at: float
    versions: Mapping[str, str]
    machine: str
    settings: Mapping[str, Any]
    work: Mapping[str, Any]
    num_frames: int
    refining_since: float | None = None
    ended_at: float | None = None
    num_resumed: int = 0
    todo: Sequence[str] = ()
    num_done: int = 0
    failed: Mapping[str, str] = field(default_factory=dict)
    reason: str | None = None

    @property
    def has_ended(self) -> bool:
        """Whether it said so; a run that was killed did not."""
        return self.state in ("finished", "stopped")

    def refining(self, num_resumed: int, todo: Sequence[str]) -> RunFile:
        """After the check of what earlier runs left."""
        return replace(self, state="running", num_resumed=num_resumed, todo=list(todo), refining_since=time.time())

    def ended(self, num_done: int, failed: Mapping[str, str], reason: str | None) -> RunFile:
        """At the end, whatever it was."""
        state: RunState = "finished" if reason is None else "stopped"
        changes = {"num_done": num_done, "failed": dict(failed), "reason": reason}
        return replace(self, state=state, todo=[], ended_at=time.time(), **changes)  # type: ignore[arg-type]

    def write(self, out_dir: Path) -> None:
        """Write `run.json`, and wait for the disk: the next run refuses one that was cut short."""
        write_json(run_path(out_dir), {"schema_version": RUN_SCHEMA_VERSION, **asdict(self)}, durable=True)


def run_path(out_dir: Path) -> Path:
    """The file of an output folder."""
    return out_dir / "run.json"


def read_run_file(out_dir: Path) -> RunFile | None:
    """The latest run into a folder, or None where there is no such file.

    Raises:
        DataFormatError: it is of another version or none at all.
    """
    path = run_path(out_dir)
    if not path.is_file():
        return None
    cure = "remove it; results do not need it"
    content = read_json(path, cure)
    if not isinstance(content, dict) or "schema_version" not in content:
        raise DataFormatError(path, "describes no run", cure=cure)
    version = content.pop("schema_version")
    if version != RUN_SCHEMA_VERSION:
        raise DataFormatError(path, f"schema version is {shown(version)}, known is {RUN_SCHEMA_VERSION}", cure=cure)
    return record_of(path, RunFile, content, cure)


def versions() -> dict[str, str]:
    """Of Python and of the packages that compute."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def digit_warnings(before: RunFile | None, now: RunFile) -> tuple[str, ...]:
    """What differs from the previous run so that the last digits of further results may differ too.

    Examples:
        >>> run = RunFile("r", "finished", 0.0, {"torch": "2.13.0"}, "x", {}, {"threads": 1}, 5)
        >>> digit_warnings(run, replace(run, work={"threads": 2}))
        ('threads: 1 in the previous run, 2 now; the last digits of results may differ',)
    """
    if before is None:
        return ()
    was = {**before.versions, **{name: before.work.get(name) for name in _DIGITS}}
    is_now = {**now.versions, **{name: now.work.get(name) for name in _DIGITS}}
    return tuple(
        f"{name}: {was.get(name)} in the previous run, {is_now[name]} now; the last digits of results may differ"
        for name in is_now
        if was.get(name) != is_now[name]
    )
