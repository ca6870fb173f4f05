"""This module runs with a disk that fails at every n-th write and rename, or without its output folder, and resumes."""

from __future__ import annotations

import builtins
import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from unittest import mock

from helpers.quick_runs import result_files

from directshape_torch.batch.options import RunObserver
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.run_folder import summary_path
from fuzzing.runs import DisturbedRuns, disturbed_runs

FRAMES = ("000000", "000001", "000002")
ERRORS = (errno.ENOSPC, errno.EIO)


class _FaultyDisk:
    """A `_FaultyDisk` counts the writes and renames below a folder, and lets one of them fail.

    Args:
        folder: folder of the files.
        fails_at: number of the operation that fails, from 0; None for none.
        number: number of the error.
    """

    def __init__(self, folder: Path, fails_at: int | None, number: int) -> None:
        self.folder, self.fails_at, self.number = str(folder), fails_at, number
        self.count = 0

    def step(self, path: object) -> None:
        """Count one operation on a path; raise if it must fail."""
        if str(path).startswith(self.folder):
            self.count += 1
            if self.count - 1 == self.fails_at:
                raise OSError(self.number, os.strerror(self.number), str(path))

    @contextmanager
    def inserted(self) -> Iterator[None]:
        """Count files that are opened for writing, and renames, while the body runs."""
        opened, replaced = builtins.open, os.replace

        def open_(path: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
            if not set(mode) & set("wxa"):
                return opened(path, mode, *args, **options)
            self.step(path)
            file = opened(path, mode, *args, **options)
            return _FaultyFile(file, path, self)

        def replace_(source: Any, target: Any, **options: Any) -> None:
            self.step(target)
            replaced(source, target, **options)

        with mock.patch("builtins.open", open_), mock.patch("os.replace", replace_):
            yield


class _FaultyFile:
    """A `_FaultyFile` is a file that receives half of the content before a write fails."""

    def __init__(self, file: IO[Any], path: object, disk: _FaultyDisk) -> None:
        self._file, self._path, self._disk = file, path, disk

    def write(self, content: Any) -> int:
        try:
            self._disk.step(self._path)
        except OSError:
            self._file.write(content[: len(content) // 2])
            raise
        return self._file.write(content)

    def __enter__(self) -> _FaultyFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


class _Taker(RunObserver):
    """A `_Taker` changes the output folder after the first frame has ended."""

    def __init__(self, out: Path, take: Callable[[Path], None]) -> None:
        self.out, self.take, self.has_taken = out, take, False

    def finished(self, frame_id: str, failure: str | None) -> None:
        if not self.has_taken:
            self.has_taken = True
            self.take(self.out)


def _files_in_its_place(out: Path) -> None:
    shutil.rmtree(out)
    out.write_text("a file")


TAKEN: dict[str, Callable[[Path], None]] = {
    "folder deleted": shutil.rmtree,
    "folder a file": _files_in_its_place,
    "data deleted": lambda out: shutil.rmtree(out / "data"),
    "summary deleted": lambda out: summary_path(out).unlink(),
    "data a file": lambda out: _files_in_its_place(out / "data"),
}


def inject_faults(every: int, report: Callable[[str], None]) -> dict[str, Any]:
    """Let every `every`-th operation fail in turn; return numbers of outcomes and the findings."""
    with disturbed_runs(FRAMES, report) as runs:
        disk = _FaultyDisk(runs.out, None, 0)
        with disk.inserted():
            runs.run()
        shutil.rmtree(runs.out)
        report(f"faults: {disk.count} writes and renames in a run of {len(FRAMES)} frames")
        for number in range(0, disk.count, every):
            for error in ERRORS:
                with _FaultyDisk(runs.out, number, error).inserted():
                    ended = _ended(runs)
                _judge(runs, f"{errno.errorcode[error]} at operation {number}", ended)
        for name, take in TAKEN.items():
            _judge(runs, name, _ended(runs, _Taker(runs.out, take)))
        return runs.figures


def _judge(runs: DisturbedRuns, name: str, ended: str) -> None:
    """Judge whether the run reported its trouble and left no false results, and whether the next run repairs it."""
    trouble = None
    if ended.startswith("foreign"):
        trouble = ended
    elif ended == "success" and result_files(runs.out) != runs.expected:
        trouble = "success, with other files than those of an undisturbed run"
    if list(runs.out.rglob("*.tmp")):
        trouble = "a temporary file stays"
    # A file in the place of a folder is for the user to remove.
    for path in (runs.out, runs.out / "data"):
        if path.is_file():
            path.unlink()
    runs.judge(name, ended.partition(":")[0], trouble)


def _ended(runs: DisturbedRuns, observer: RunObserver | None = None) -> str:
    """The outcome of a run: "success", "told by its exit code", "told by an error", "foreign exception"."""
    try:
        return "told by its exit code" if runs.run(observer) else "success"
    except (DirectShapeError, OSError) as error:
        return f"told by an error: {error}"
    except Exception as error:
        return f"foreign exception: {error!r}"
