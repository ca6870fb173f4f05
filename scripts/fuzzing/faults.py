"""Runs whose disk fails at every n-th write and rename, or whose output folder goes; the next one goes on."""

from __future__ import annotations

import builtins
import errno
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from unittest import mock

from helpers.faulty_refiners import QuickRefiner
from helpers.kitti_folder import write_data_set
from helpers.output_folders import result_files
from helpers.quick_runs import dataset

from directshape_torch.batch.options import RefineOptions, RunObserver
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_log import log_path, read_log
from directshape_torch.errors import DirectShapeError

FRAMES = ("000000", "000001", "000002")
ERRORS = (errno.ENOSPC, errno.EIO)


class _FaultyDisk:
    """Counts the writes and renames below a folder, and lets one of them fail.

    Args:
        folder: whose files are meant.
        fails_at: number of the operation, from 0; None for none.
        number: of the error.
    """

    def __init__(self, folder: Path, fails_at: int | None, number: int) -> None:
        self.folder, self.fails_at, self.number = str(folder), fails_at, number
        self.count = 0

    def step(self, path: object) -> None:
        """One operation on a path."""
        if str(path).startswith(self.folder):
            self.count += 1
            if self.count - 1 == self.fails_at:
                raise OSError(self.number, os.strerror(self.number), str(path))

    @contextmanager
    def inserted(self) -> Iterator[None]:
        """Files that are opened for writing, and renames, go through it."""
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
    """A file of which half of what is written arrives before the write fails."""

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
    """Does something to the output folder once the first frame has ended."""

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
    "log deleted": lambda out: log_path(out).unlink(),
    "data a file": lambda out: _files_in_its_place(out / "data"),
}


def inject_faults(every: int, report: Callable[[str], None]) -> dict[str, Any]:
    """Let every `every`-th operation fail by itself; how the runs ended, and those that ended as none should."""
    folder = Path(tempfile.mkdtemp(prefix="faults"))
    counts: Counter[str] = Counter()
    found: list[dict[str, Any]] = []
    try:
        root = folder / "kitti"
        write_data_set(root, FRAMES)
        disk = _FaultyDisk(folder / "undisturbed", None, 0)
        with disk.inserted():
            _run(root, folder / "undisturbed")
        expected, out = result_files(folder / "undisturbed"), folder / "out"
        report(f"faults: {disk.count} writes and renames in a run of {len(FRAMES)} frames")
        for number in range(0, disk.count, every):
            for error in ERRORS:
                name = f"{errno.errorcode[error]} at operation {number}"
                with _FaultyDisk(out, number, error).inserted():
                    ended = _ended(root, out)
                _judge(name, ended, root, out, expected, counts, found)
        for name, take in TAKEN.items():
            _judge(name, _ended(root, out, _Taker(out, take)), root, out, expected, counts, found)
        for each in found:
            report(f"fault: {each['name']}: {each['said']}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return {
        **dict(sorted(counts.items())),
        "runs that did not go on to the same bytes": len(found),
        "found": found,
    }


def _judge(
    name: str,
    ended: str,
    root: Path,
    out: Path,
    expected: dict[str, bytes],
    counts: Counter[str],
    found: list[dict[str, Any]],
) -> None:
    """Whether the run told of its trouble, left nothing that lies, and the next one repairs it."""
    counts[ended.partition(":")[0]] += 1
    trouble = None
    if ended.startswith("foreign"):
        trouble = ended
    elif ended == "success" and result_files(out) != expected:
        trouble = "success, with other files than those of an undisturbed run"
    if out.is_dir():
        if log_path(out).exists():
            read_log(out)
        if list(out.rglob("*.tmp")):
            trouble = "a temporary file stays"
    # What stands in the place of a folder is for the user to remove.
    for path in (out, out / "data"):
        if path.is_file():
            path.unlink()
    try:
        code = _run(root, out).exit_code
        if code != 0 or result_files(out) != expected:
            trouble = trouble or f"the next run ends with exit code {code} or other files"
    except Exception as error:
        trouble = f"the next run raises {error!r}"
    if trouble is not None:
        found.append({"name": name, "said": trouble})
    shutil.rmtree(out, ignore_errors=True)


def _ended(root: Path, out: Path, observer: RunObserver | None = None) -> str:
    """How a run ended: "success", "told by its exit code", "told by an error", "foreign exception"."""
    try:
        code = _run(root, out, observer).exit_code
    except (DirectShapeError, OSError) as error:
        return f"told by an error: {error}"
    except Exception as error:
        return f"foreign exception: {error!r}"
    return "told by its exit code" if code else "success"


def _run(root: Path, out: Path, observer: RunObserver | None = None) -> Any:
    return refine_dataset(dataset(root), QuickRefiner(root), out, RefineOptions(threads=1), observer)
