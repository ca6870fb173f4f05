"""What finished while a run goes on: each process appends one checksummed line a frame to a file of its own.

    OUT/journal/RUN-HOST-PID.jsonl      lines "CHECKSUM {..}\n"; the checksum is the start of the sha256 of the rest

A line that was cut short (a killed process, a full disk) does not have its checksum and counts as not written, so its
frame is done again. The summary takes the lines in at the end of a run, and the files go.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import parse_json
from directshape_torch.files.schema import record_of
from directshape_torch.io.run_manifest import check_frames, hash_bytes

_CHECKSUM_DIGITS = 16


@dataclass(frozen=True)
class FrameRecord:
    """How a frame ended.

    Attributes:
        frame_id: of the data set.
        inputs: sha256 of its files by their role; empty where it failed.
        entry: what `summary.json` says of it.
        finished_at: seconds since 1970.
    """

    frame_id: str
    inputs: dict[str, str]
    entry: dict[str, Any]
    finished_at: float = field(default_factory=time.time)

    @property
    def failure(self) -> str | None:
        """Why it failed, or None."""
        reason: str | None = self.entry.get("reason")
        return reason


class Journal:
    """The journal of one process.

    Args:
        out_dir: the output folder.
        run_id: of the run, so that the journals of one run can be told from those of another.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> Journal(folder, "r1").add(FrameRecord("000107", {}, {"state": "done"}))
        >>> [record.frame_id for record in read_journals(folder).records]
        ['000107']
    """

    def __init__(self, out_dir: Path, run_id: str) -> None:
        host = "".join(letter for letter in platform.node() if letter.isalnum()) or "host"
        self.path = journal_folder(out_dir) / f"{run_id}-{host}-{os.getpid()}.jsonl"

    def add(self, record: FrameRecord) -> None:
        """Append a line; all of it or, where that fails, nothing.

        Raises:
            OSError: it could not be written.
        """
        payload = json.dumps(vars(record), sort_keys=True, allow_nan=False).encode()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab", buffering=0) as file:
            length = file.seek(0, os.SEEK_END)
            line = memoryview(_checksum(payload) + b" " + payload + b"\n")
            try:
                while line:
                    line = line[file.write(line) :]
            except OSError:
                file.truncate(length)
                raise


@dataclass(frozen=True)
class JournalContents:
    """All journals of a folder.

    Attributes:
        records: in the order in which the frames ended.
        num_damaged: lines that were cut short, or that no run has written.
    """

    records: list[FrameRecord]
    num_damaged: int


def journal_folder(out_dir: Path) -> Path:
    """Where the journals of an output folder lie."""
    return out_dir / "journal"


def read_journals(out_dir: Path, run_id: str | None = None) -> JournalContents:
    """The journals of all runs, or of one; also while they are written."""
    records, num_damaged = [], 0
    for path in sorted(journal_folder(out_dir).glob(f"{'' if run_id is None else run_id}*.jsonl")):
        # A run that ends takes its journals away.
        with suppress(FileNotFoundError):
            for record in _read(path) if path.is_file() else ():
                if record is None:
                    num_damaged += 1
                else:
                    records.append(record)
    return JournalContents(sorted(records, key=lambda record: record.finished_at), num_damaged)


def remove_journals(out_dir: Path) -> None:
    """Forget all lines, after the summary has taken them in."""
    folder = journal_folder(out_dir)
    for path in folder.glob("*.jsonl"):
        path.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _read(path: Path) -> Iterator[FrameRecord | None]:
    """The records of a file, None for each damaged line."""
    with open(path, "rb") as file:
        for line in file:
            checksum, _, payload = line.removesuffix(b"\n").partition(b" ")
            whole = line.endswith(b"\n") and checksum == _checksum(payload)
            yield _record(path, payload) if whole else None


def _record(path: Path, payload: bytes) -> FrameRecord | None:
    """None for what no run has written, though its checksum is right."""
    try:
        record = record_of(path, FrameRecord, parse_json(path, payload))
        check_frames(path, {record.frame_id: record.entry})
    except DataFormatError:
        return None
    return record


def _checksum(payload: bytes) -> bytes:
    return hash_bytes(payload)[:_CHECKSUM_DIGITS].encode()
