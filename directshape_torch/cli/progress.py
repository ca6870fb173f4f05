"""This module shows progress bars over frames on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import Any, Self

from tqdm import tqdm

from directshape_torch.batch.options import RunObserver


class Bar(tqdm):  # type: ignore[type-arg]
    """A `Bar` has no thread that would outlive it, and appears after the first step, so errors appear without it."""

    monitor_interval = 0

    def __init__(self, iterable: Iterable[Any] | None = None, **options: Any) -> None:
        super().__init__(iterable, delay=1e-3, **options)


class ProgressBar(RunObserver):
    """A `ProgressBar` counts frames and prints failures while `refine_dataset` runs."""

    def __init__(self) -> None:
        self._bar: Bar | None = None
        self._num_failed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def started(self, frame_ids: Sequence[str]) -> None:
        """Show the bar, unless there are no frames to refine."""
        if frame_ids:
            self._bar = Bar(total=len(frame_ids), unit="frame", desc="refine")

    def finished(self, frame_id: str, failure: str | None) -> None:
        """Advance the bar; print the reason of a failure above it."""
        assert self._bar is not None, "a frame finished before the run started"
        if failure is not None:
            self._num_failed += 1
            self._bar.write(f"frame {frame_id} failed: {failure}", file=sys.stderr)
            self._bar.set_postfix(failed=self._num_failed)
        self._bar.update()
