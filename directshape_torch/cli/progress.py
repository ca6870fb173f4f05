"""Progress bars over frames, on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import Any, Self

from tqdm import tqdm

from directshape_torch.batch.options import RunObserver


class Bar(tqdm):  # type: ignore[type-arg]
    """Without the thread that would outlive it, and shown after the first step, so that an error comes alone."""

    monitor_interval = 0

    def __init__(self, iterable: Iterable[Any] | None = None, **options: Any) -> None:
        super().__init__(iterable, delay=1e-3, **options)


class ProgressBar(RunObserver):
    """Counts frames and tells of those that fail, while `refine_dataset` runs."""

    def __init__(self) -> None:
        self._bar: Bar | None = None
        self._num_failed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def started(self, frame_ids: Sequence[str]) -> None:
        """Show the bar; nothing where there is nothing to do."""
        if frame_ids:
            self._bar = Bar(total=len(frame_ids), unit="frame", desc="refine")

    def finished(self, frame_id: str, failure: str | None) -> None:
        """Advance; print the reason of a failure above the bar."""
        assert self._bar is not None, "a frame finished before the run started"
        if failure is not None:
            self._num_failed += 1
            self._bar.write(f"frame {frame_id} failed: {failure}", file=sys.stderr)
            self._bar.set_postfix(failed=self._num_failed)
        self._bar.update()
