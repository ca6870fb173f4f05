"""This module keeps `run.jsonl`, the log of the run in an output folder; results do not depend on it.

The active run locks the file, so that only one run writes at a time, and appends a line of JSON for each event. A line
that was cut short (by a killed process or a full disk) is ignored.
"""

from __future__ import annotations

import errno
import importlib.metadata
import json
import os
import platform
import stat
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Literal, Self

from directshape_torch.errors import DataFormatError, DirectShapeError, RunInProgressError, shown
from directshape_torch.files.read_files import parse_json, read_bytes
from directshape_torch.files.schema import record_of

try:
    import fcntl
except ImportError:  # only Unix has it; elsewhere there is no lock, but the owner is named
    fcntl = None  # type: ignore[assignment]

LOG_SCHEMA_VERSION = 1
_BEGINNING = b'{"schema": "directshape run", '
# Some systems lack these flags.
_LOCK_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
_PACKAGES = ("directshape_torch", "torch", "numpy", "opencv-python-headless", "scipy")
# The last digits of a result depend on these settings.
_DIGITS = ("threads", "batch_frames", "device")


class OutputLostError(DirectShapeError):
    """No more results can be written to the output folder."""


@contextmanager
def writing_to(out_dir: Path) -> Iterator[None]:
    """Raise `OutputLostError` if the disk is full while the body runs."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK_IS_FULL:
            raise
        raise OutputLostError(
            f"cannot write to {out_dir} any more ({error.strerror or error}): make room there and run the same command "
            "again; what is finished stays finished"
        ) from error


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


@dataclass(frozen=True)
class RunBeginning:
    """A `RunBeginning` is the first line of the log."""

    # Keys are "where" ("this process" or "processes"), "workers", "threads" of each, "device", "batch_frames" and
    # "outputs".
    work: Mapping[str, Any]
    num_frames: int  # number of frames of the data set
    # The process that the user started.
    host: str = field(default_factory=platform.node)
    pid: int = field(default_factory=os.getpid)
    started_at: float = field(default_factory=time.time)  # seconds since 1970, as for all times
    versions: Mapping[str, str] = field(default_factory=_versions)  # of Python and of the packages that compute

    @property
    def is_alive(self) -> bool | None:
        """Whether the process runs; None if it is on another machine."""
        if self.host != platform.node():
            return None
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):  # no process has this number
            return False
        except PermissionError:  # it runs, but belongs to another user
            return True
        return True

    @property
    def owner(self) -> str:
        """The process and its start in words."""
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.started_at))
        return f"process {self.pid} on {self.host}, since {since}"


@dataclass(frozen=True)
class RunEvent:
    """A `RunEvent` is a later line: a frame has ended, earlier results have been checked, or the run has ended."""

    at: float
    frame: str | None = None
    failure: str | None = None  # why the frame is not done
    resumed: int | None = None  # number of frames that earlier runs had done
    end: Literal["finished", "stopped"] | None = None
    # These are set at the end: frames that are done, why others are not, and why the run was stopped.
    done: int = 0
    failed: Mapping[str, str] = field(default_factory=dict)
    reason: str | None = None


class RunLog:
    """A `RunLog` locks a folder while the body runs; the operating system releases the lock when the process ends.

    It raises `RunInProgressError` if another process holds the lock.
    """

    def __init__(self, out_dir: Path) -> None:
        self.out_dir, self.path = out_dir, log_path(out_dir)
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # A link is refused, because its target would be emptied.
        try:
            file = open(self.path, "a+b", buffering=0, opener=_opened)
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise DataFormatError(self.path, problem, cure="remove it, or choose another output folder") from error
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not self._is_at_its_place(file):
                raise BlockingIOError("its last owner has just removed it")
            read_log(self.out_dir)
        except (BlockingIOError, FileNotFoundError) as error:
            file.close()
            raise RunInProgressError(
                f"{self.out_dir}: another run is writing here ({self._owner()}); wait for it, stop it, or choose "
                "another output folder ('directshape status' shows how far it is)"
            ) from error
        except DataFormatError:
            file.close()
            raise
        self._file = file
        return self

    def __exit__(self, *_: object) -> None:
        file, self._file = self._file, None
        assert file is not None, "the folder is held"
        with file, suppress(OSError):
            # A run that did not begin leaves no log. The file is removed before its lock is released, so that no
            # process locks a file that is about to vanish. In a moved folder the path may belong to another run by now.
            if not os.fstat(file.fileno()).st_size and self._is_at_its_place(file):
                self.path.unlink()

    def begin(self, beginning: RunBeginning) -> None:
        """Remove the log of the previous run and write the first line."""
        assert self._file is not None, "the folder is held"
        self._file.truncate(0)
        start = json.loads(_BEGINNING.rstrip(b", ") + b"}")
        self._append({**start, "schema_version": LOG_SCHEMA_VERSION, **asdict(beginning)})

    def add(self, event: RunEvent) -> None:
        """Write a later line with the known values of an event."""
        nothing = asdict(RunEvent(event.at))
        self._append({k: value for k, value in asdict(event).items() if k == "at" or value != nothing[k]})

    def _append(self, content: Mapping[str, Any]) -> None:
        """Append a complete line, or nothing if writing fails."""
        file = self._file
        assert file is not None, "the folder is held"
        length = os.fstat(file.fileno()).st_size
        rest = memoryview(json.dumps(content, allow_nan=False).encode() + b"\n")
        with writing_to(self.out_dir):
            try:
                while rest:
                    rest = rest[file.write(rest) :]
            except OSError:
                file.truncate(length)
                raise

    def _is_at_its_place(self, file: IO[bytes]) -> bool:
        """Whether the path still leads to the locked file."""
        return os.path.samestat(os.fstat(file.fileno()), self.path.stat())

    def _owner(self) -> str:
        with suppress(DataFormatError):
            if (log := read_log(self.out_dir)) is not None:
                return log[0].owner
        return "its owner is not known"


def _opened(path: str, flags: int) -> int:
    number = os.open(path, flags | _LOCK_FLAGS, 0o666)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError(errno.EINVAL, "it is no regular file")
    return number


def log_path(out_dir: Path) -> Path:
    """The log file of an output folder."""
    return out_dir / "run.jsonl"


def read_log(out_dir: Path) -> tuple[RunBeginning, list[RunEvent]] | None:
    """The log of the latest run into a folder, also of a running one; None if no run has begun."""
    path, cure = log_path(out_dir), "remove it; results do not need it"
    if not path.is_file():
        return None
    first, is_whole, rest = read_bytes(path).partition(b"\n")
    if not is_whole and first[: len(_BEGINNING)] == _BEGINNING[: len(first)]:  # cut short, or not yet written
        return None
    content = parse_json(path, first, cure)
    if not isinstance(content, dict) or content.pop("schema", None) != "directshape run":
        raise DataFormatError(path, "describes no run", cure=cure)
    version = content.pop("schema_version", None)
    if version != LOG_SCHEMA_VERSION:
        raise DataFormatError(path, f"schema version is {shown(version)}, known is {LOG_SCHEMA_VERSION}", cure=cure)
    events = []
    for line in rest.splitlines():
        with suppress(DataFormatError):  # it was cut short
            events.append(record_of(path, RunEvent, parse_json(path, line)))
    return record_of(path, RunBeginning, content, cure), events


def digit_warnings(before: RunBeginning, now: RunBeginning) -> list[str]:
    """Warnings about differences from the previous run that may change the last digits of further results.

    Examples:
        >>> digit_warnings(RunBeginning({"threads": 1}, 5), RunBeginning({"threads": 2}, 5))
        ['threads: 1 in the previous run, 2 now; the last digits of results may differ']
    """
    was, is_now = ({**run.versions, **{name: run.work.get(name) for name in _DIGITS}} for run in (before, now))
    return [
        f"{name}: {was.get(name)} in the previous run, {value} now; the last digits of results may differ"
        for name, value in is_now.items()
        if was.get(name) != value
    ]
