"""A finished run is read only where its files belong together."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.finished_run import FinishedRun

from directshape_torch.errors import DataFormatError
from directshape_torch.io.run_folder import RunFolder


def test_files_that_do_not_fit_together_are_named(finished: FinishedRun, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished.out, tmp_path / "out"))
    result = out / "data" / "000000.txt"
    result.write_text("".join(result.read_text().splitlines(keepends=True)[:1]))
    with pytest.raises(DataFormatError, match=r"data/000000.txt: has been changed, or does not belong to .*npz"):
        RunFolder(out).read("000000")
