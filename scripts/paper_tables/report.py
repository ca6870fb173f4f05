"""Tables as Markdown and CSV, and the record of what made them."""

from __future__ import annotations

import csv
import io
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from directshape_torch.batch.refine_dataset import package_version
from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.run_manifest import RunManifest, hash_file, write_manifest

FEW_CARS = 30
"""Below this many physical cars a table says that they are few."""


@dataclass(frozen=True)
class Table:
    """A table for readers.

    Attributes:
        title: a heading.
        columns: their names.
        rows: cells as text.
        notes: sentences below it.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """The table with its heading and notes.

        Examples:
            >>> print(Table("Cars", ("n",), (("3",),)).markdown())
            ## Cars
            <BLANKLINE>
            | n |
            |---|
            | 3 |
        """
        lines = [f"## {self.title}", "", _line(self.columns), "|" + "---|" * len(self.columns)]
        lines += [_line(row) for row in self.rows]
        return "\n".join([*lines, *(f"\n{note}" for note in self.notes)])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


@dataclass
class Report:
    """Everything one experiment writes: `NAME.md`, `NAME*.csv` and `NAME_manifest.json`.

    Attributes:
        name: of the experiment.
        folder: where it goes.
        settings: options of the command, for the record.
    """

    name: str
    folder: Path
    settings: dict[str, Any]
    tables: list[Table] = field(default_factory=list)

    def add(self, table: Table) -> None:
        """Append a table, and write all so far: a long run leaves what it has."""
        self.tables.append(table)
        write_text(self.folder / f"{self.name}.md", "\n\n".join(table.markdown() for table in self.tables) + "\n")

    def write_csv(self, suffix: str, rows: Sequence[dict[str, Any]]) -> None:
        """Write `NAME_SUFFIX.csv` with full figures; all rows have the same keys."""
        if not rows:
            return
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.folder / f"{self.name}_{suffix}.csv", text.getvalue())

    def write_record(self, runs: Sequence[Path]) -> None:
        """Versions, options and seeds, and the hash of the summary of each run that the tables were made of."""
        versions = {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "opencv": cv2.__version__,
        }
        summaries = {"/".join(run.parts[-3:]): run / "summary.json" for run in dict.fromkeys(runs)}
        hashes: dict[str, str | None] = {name: hash_file(path) for name, path in summaries.items() if path.is_file()}
        config = {"experiment": self.name, "options": self.settings, "versions": versions}
        write_manifest(self.folder / f"{self.name}_manifest.json", RunManifest(package_version(), config, hashes))


def interval(estimate: Estimate, digits: int = 3) -> str:
    """A figure with its interval, where there is one.

    Examples:
        >>> interval(Estimate(0.5, 0.25, 0.75), 2), interval(Estimate(0.5, None, None), 2)
        ('0.50 [0.25, 0.75]', '0.50')
    """
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.{digits}f}"
    return f"{estimate.value:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def few_cars_note(num_cars: int, num_rows: int, what: str = "detections") -> tuple[str, ...]:
    """A sentence where there are few physical cars."""
    if num_cars >= FEW_CARS:
        return ()
    return (f"Few cars: {num_rows} {what} of {num_cars} physical cars, so read the intervals, not the digits.",)
