"""What all tables share: the data sets, the runs, and how boxes are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.evaluation.bootstrap import BootstrapSettings
from directshape_torch.evaluation.comparison import Comparison, LineFilter, compare_results, lines_with_left_mask
from paper_tables.data_sets import DataSet
from paper_tables.refinements import Refinery, Run
from paper_tables.report import Report
from paper_tables.settings import DEFAULT, Settings

QUICK_FRAMES = 2


@dataclass(frozen=True)
class Experiment:
    """One call of the program.

    Attributes:
        data_sets: to run on.
        refinery: makes the runs.
        report: gets the tables.
        frames: ids, or None for all.
        detectors: names, or None for the table's own choice.
        bootstrap: of the intervals.
        seed: of simulated detections.
        quick: a few frames and rows, to try everything.
        only_groups: the groups of the ablation to run beside the reference; empty for all.
    """

    data_sets: tuple[DataSet, ...]
    refinery: Refinery
    report: Report
    frames: tuple[str, ...] | None
    detectors: tuple[str, ...] | None
    bootstrap: BootstrapSettings
    seed: int
    quick: bool
    only_groups: tuple[str, ...] = ()

    def detectors_of(self, data_set: DataSet) -> dict[str, Path]:
        """Folders of detections by name, those that the user chose."""
        chosen = data_set.detections if self.detectors is None else self.detectors
        return {name: data_set.detections[name] for name in chosen if name in data_set.detections}

    def frames_of(self, data_set: DataSet, detections: Path) -> tuple[str, ...]:
        """Frames of a detector that this call is about."""
        frames = data_set.frames_of(detections, self.frames)
        return frames[:QUICK_FRAMES] if self.quick else frames

    def run(self, data_set: DataSet, detections: Path, settings: Settings) -> Run:
        """The refinement of these frames."""
        return self.refinery.run(data_set, detections, settings, self.frames_of(data_set, detections))

    def masked_lines(self, data_set: DataSet, detections: Path) -> LineFilter:
        """Detections that have a left mask among the data set's own, so that all rows count the same cars."""
        return lines_with_left_mask(self.run(data_set, detections, DEFAULT).out / "shapes")

    def compare(self, data_set: DataSet, run: Run, keep_line: LineFilter) -> Comparison:
        """Boxes before and after, car by car."""
        return compare_results(
            data_set.labels,
            run.before,
            run.out / "data",
            frames=run.frame_ids,
            tracks=data_set.tracks,
            keep_line=keep_line,
            bootstrap=self.bootstrap,
        )


def share_percent(values: Sequence[bool]) -> float:
    """Percent of true values; NaN without any."""
    return 100 * sum(values) / len(values) if values else float("nan")
