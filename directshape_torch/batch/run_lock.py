"""One run at a time in an output folder: a locked file that names its owner."""

from __future__ import annotations

import json
import os
import platform
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Self

from directshape_torch.errors import DataFormatError, RunInProgressError
from directshape_torch.files.read_files import read_json
from directshape_torch.files.schema import record_of

try:
    import fcntl
except ImportError:  # only Unix has it; elsewhere nothing is locked, but the owner is named
    fcntl = None  # type: ignore[assignment]


# Not every system has the last two.
_LOCK_FLAGS = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


@dataclass(frozen=True)
class LockOwner:
    """The process that runs in a folder.

    Attributes:
        host: name of its machine.
        pid: number of the process there.
        started_at: seconds since 1970.
    """

    host: str
    pid: int
    started_at: float

    @property
    def is_alive(self) -> bool | None:
        """Whether the process runs; None where it is on another machine."""
        if self.host != platform.node():
            return None
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except OverflowError:  # no process has such a number
            return False
        except PermissionError:  # it runs, but is somebody else's
            return True
        return True

    def __str__(self) -> str:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.started_at))
        return f"process {self.pid} on {self.host}, since {since}"


class RunLock:
    """Holds the folder while the body runs; the operating system lets go of it however the process ends.

    Raises:
        RunInProgressError: another process holds it.
    """

    def __init__(self, out_dir: Path) -> None:
        self.path = lock_path(out_dir)
        self._file: IO[str] | None = None

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        while self._file is None:
            self._file = self._locked()
        try:
            self._file.truncate(0)
            json.dump({"host": platform.node(), "pid": os.getpid(), "started_at": time.time()}, self._file)
            self._file.flush()
        except OSError:  # the disk is full
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is None:
            return
        # Removed before it is let go of, so that nobody locks a file that is about to vanish; of a moved folder it
        # may be another run's by now.
        try:
            with suppress(FileNotFoundError, NotADirectoryError):
                if self._is_at_its_place(self._file):
                    self.path.unlink()
        finally:
            file, self._file = self._file, None
            with suppress(OSError):  # what a full disk did not take
                file.close()

    def _is_at_its_place(self, file: IO[str]) -> bool:
        """Whether the path still leads to the file that is held."""
        return os.path.samestat(os.fstat(file.fileno()), self.path.stat())

    def _locked(self) -> IO[str] | None:
        """The file, held; None where its last owner removed it in between."""
        # Not "w": that would empty the file of a run that holds it. A link is no lock: it would empty what it leads to.
        try:
            file = os.fdopen(os.open(self.path, _LOCK_FLAGS, 0o666), "a+", encoding="utf-8")
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise DataFormatError(self.path, problem, cure="remove it, or choose another output folder") from error
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if self._is_at_its_place(file):
                return file
        except BlockingIOError as error:
            file.close()
            owner = read_lock_owner(self.path.parent)
            raise RunInProgressError(
                f"{self.path.parent}: another run is writing here ({owner or 'its owner is not known'}); wait for it, "
                "stop it, or choose another output folder ('directshape status' shows how far it is)"
            ) from error
        except FileNotFoundError:
            pass
        file.close()
        return None


def lock_path(out_dir: Path) -> Path:
    """The file that is locked."""
    return out_dir / ".run.lock"


def read_lock_owner(out_dir: Path) -> LockOwner | None:
    """Who runs in the folder, or did when it was killed; None where nobody is named."""
    path = lock_path(out_dir)
    with suppress(DataFormatError):
        return record_of(path, LockOwner, read_json(path))
    return None
