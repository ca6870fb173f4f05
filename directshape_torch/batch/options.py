"""This module has the options of a run over a data set, and the observer that is told of its progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refinement.result import RefinementResult


@dataclass(frozen=True)
class RefineOptions:
    """A `RefineOptions` has the outputs of `refine_dataset` and its processes.

    Attributes:
        draw: function that draws the overlay of each frame (`visualize.overlay.overlay_of_frame`); None writes none.
            Workers import it by its name.
        batch_frames: number of frames refined together in one call.
        workers: number of parallel processes. None: only this process.
        threads: number of threads of each process. None: this process keeps its number, and a worker gets 1.
        ray: address "HOST:PORT" of a cluster of Ray, whose processes are the workers (docs/many_machines.md).

    Raises:
        InputError: a number is too small, or both `workers` and `ray` are given.

    Examples:
        >>> RefineOptions(workers=4).threads_per_worker
        1
    """

    draw: Callable[[LoadedFrame, RefinementResult], NDArray[np.uint8]] | None = None
    batch_frames: int = 1
    workers: int | None = None
    threads: int | None = None
    ray: str | None = None

    def __post_init__(self) -> None:
        for name in ("batch_frames", "workers", "threads"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise InputError(name, "at least 1", str(number))
        if self.ray is not None and self.workers is not None:
            raise InputError("workers", "none with ray, whose nodes have them", str(self.workers))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the kinds of files that each frame gets."""
        return ("data", "shapes") if self.draw is None else ("data", "shapes", "overlays")

    @property
    def threads_per_worker(self) -> int | None:
        """The number of threads to set, or None to leave it unchanged."""
        has_workers = self.workers is not None or self.ray is not None
        return 1 if has_workers and self.threads is None else self.threads


class RunObserver:
    """A `RunObserver` is told of the progress of a run, for example to show it; this class ignores it."""

    def started(self, frame_ids: Sequence[str]) -> None:
        """Called before refinement with all frames to refine, without finished frames of an earlier run."""

    def finished(self, frame_id: str, failure: str | None) -> None:
        """Called when a frame is done, or has failed for the given reason."""
