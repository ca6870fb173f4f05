"""Lines of a journal are whole or do not count."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from directshape_torch.batch.journal import FrameRecord, Journal, journal_folder, read_journals, remove_journals


def record(frame_id: str, finished_at: float = 0.0) -> FrameRecord:
    return FrameRecord(frame_id, {"image_left": "ab"}, {"state": "done", "cars": 2}, finished_at)


def test_lines_come_back_in_the_order_of_time_over_all_processes(tmp_path: Path) -> None:
    Journal(tmp_path, "b").add(record("000001", 3.0))
    Journal(tmp_path, "a").add(record("000002", 2.0))
    Journal(tmp_path, "b").add(record("000003", 1.0))
    assert read_journals(tmp_path).records == [record("000003", 1.0), record("000002", 2.0), record("000001", 3.0)]
    assert read_journals(tmp_path, "a").records == [record("000002", 2.0)]
    assert len(list(journal_folder(tmp_path).iterdir())) == 2
    remove_journals(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert read_journals(tmp_path).records == []


def test_a_line_cut_anywhere_counts_for_nothing_and_the_others_stay(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "run")
    journal.add(record("000000"))
    length = journal.path.stat().st_size
    journal.add(record("000001"))
    content = journal.path.read_bytes()
    for end in range(length, len(content)):
        journal.path.write_bytes(content[:end])
        found = read_journals(tmp_path)
        assert [entry.frame_id for entry in found.records] == ["000000"]
        assert found.num_damaged == (end > length)


def test_a_changed_line_counts_for_nothing(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "run")
    for frame_id in ("000000", "000001", "000002"):
        journal.add(record(frame_id))
    journal.path.write_bytes(journal.path.read_bytes().replace(b"000001", b"000007"))
    found = read_journals(tmp_path)
    assert [entry.frame_id for entry in found.records] == ["000000", "000002"]
    assert found.num_damaged == 1


def test_what_a_full_disk_took_of_a_line_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path, "run")
    journal.add(record("000000"))
    whole = journal.path.read_bytes()
    real_open = open

    def nearly_full(path: object, mode: str, buffering: int) -> object:
        file = real_open(path, mode, buffering=buffering)  # type: ignore[call-overload]

        class Disk:
            left = 10

            def __enter__(self) -> Disk:
                return self

            def __exit__(self, *_: object) -> None:
                file.close()

            def write(self, content: memoryview) -> int:
                if not self.left:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                taken, self.left = self.left, 0
                written: int = file.write(content[:taken])
                return written

            seek, truncate = file.seek, file.truncate

        return Disk()

    monkeypatch.setattr("builtins.open", nearly_full)
    with pytest.raises(OSError, match="No space left"):
        journal.add(record("000001"))
    monkeypatch.undo()
    assert journal.path.read_bytes() == whole
    journal.add(record("000001"))
    assert len(read_journals(tmp_path).records) == 2
