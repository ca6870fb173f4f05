"""This module disturbs runs; the next run must end with the bytes of an undisturbed run."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from helpers.kitti_folder import write_data_set
from helpers.quick_runs import QuickRefiner, dataset, result_files

from directshape_torch.batch.options import RefineOptions, RunObserver
from directshape_torch.batch.refine_dataset import refine_dataset


class DisturbedRuns:
    """A `DisturbedRuns` counts disturbances of runs into the folder `out`, and the results of the next runs.

    Args:
        folder: folder of data set and outputs.
        frames: frames of the data set.
        report: function that is told of each disturbance.
    """

    def __init__(self, folder: Path, frames: Sequence[str], report: Callable[[str], None]) -> None:
        self.root, self.out, self.report = folder / "kitti", folder / "out", report
        write_data_set(self.root, frames)
        self.run()
        self.expected = result_files(self.out)
        shutil.rmtree(self.out)
        self.counts, self.found = Counter[str](), list[dict[str, str]]()

    def run(self, observer: RunObserver | None = None) -> int:
        """Refine in this process; return the exit code."""
        options = RefineOptions(threads=1)
        return refine_dataset(dataset(self.root), QuickRefiner(self.root), self.out, options, observer).exit_code

    def judge(self, name: str, kind: str, trouble: str | None) -> None:
        """Let the next run repair a disturbance of some kind, which has shown a trouble itself or none."""
        self.counts[kind] += 1
        try:
            code = self.run()
            if code != 0 or result_files(self.out) != self.expected:
                trouble = trouble or f"the next run ends with exit code {code} or other files"
        except Exception as error:
            trouble = f"the next run raises {error!r}"
        if trouble is not None:
            self.found.append({"name": name, "said": trouble})
        self.report(f"{name}: {trouble or 'resumed to the same bytes'}")
        shutil.rmtree(self.out, ignore_errors=True)

    @property
    def figures(self) -> dict[str, Any]:
        """Numbers of disturbances by kind, and the findings."""
        number = {"runs that did not go on to the same bytes": len(self.found)}
        return {**dict(sorted(self.counts.items())), **number, "found": self.found}


@contextmanager
def disturbed_runs(frames: Sequence[str], report: Callable[[str], None]) -> Iterator[DisturbedRuns]:
    """Disturbed runs in a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="runs", ignore_cleanup_errors=True) as folder:
        yield DisturbedRuns(Path(folder), frames, report)
