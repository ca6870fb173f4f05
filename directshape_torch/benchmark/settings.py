"""What all suites are told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from directshape_torch.benchmark.timing import Repetitions


def _silent(line: str) -> None:
    """Progress that nobody wants to see."""


@dataclass(frozen=True)
class SuiteSettings:
    """How a suite runs.

    Attributes:
        data_root: folder that holds `rendered` and `kitti`, or None for the bundled frame.
        quick: fewer frames, sizes and repetitions; to see that everything runs, not to quote.
        repetitions: of whatever is timed.
        progress: is told, line by line, what is measured next.
    """

    data_root: Path | None = None
    quick: bool = False
    repetitions: Repetitions = field(default_factory=Repetitions)
    progress: Callable[[str], None] = _silent

    @classmethod
    def make(cls, data_root: Path | None, quick: bool, progress: Callable[[str], None] = _silent) -> SuiteSettings:
        """With as many repetitions as fit the purpose."""
        repetitions = Repetitions(warm_up=1, rounds=2, budget_s=5.0) if quick else Repetitions()
        return cls(data_root, quick, repetitions, progress)

    @property
    def max_frames(self) -> int | None:
        """Frames of a data set."""
        return 1 if self.quick else None
