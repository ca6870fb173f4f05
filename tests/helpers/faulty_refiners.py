"""This module has refiners that disturb their process; they are classes, so that they can be sent to workers."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from directshape_torch.config import RefinerConfig
from directshape_torch.io.config_files import load_config
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior

# The model of trust does not know toys that have not converged.
EVERY_RESULT = ("acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0")
# Cameras are exact, and what the images say is to be seen as it is.
IMAGES_ALONE = ("rig.disparity_sigma_px=0", "priors.detector_weight=0")
FEW_STEPS = ("stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 2}]", *EVERY_RESULT, *IMAGES_ALONE)


def few_steps() -> RefinerConfig:
    return load_config(None, FEW_STEPS)


class QuickRefiner(DirectShapeRefiner):
    """A `QuickRefiner` has two iterations, with the prior of a data set of `helpers.kitti_folder`."""

    def __init__(self, root: Path) -> None:
        super().__init__(PCAShapePrior.load(root / "prior.safetensors"), few_steps())


class DeadlyRefiner(QuickRefiner):
    """A `DeadlyRefiner` kills its process, as the system does without memory, if certain frames are in the call.

    Args:
        root: root of the data set.
        always: frames that kill each time.
        once: frames that kill only the first time, recorded by a file in the folder `notes`.
    """

    def __init__(self, root: Path, notes: Path, always: Collection[str] = (), once: Collection[str] = ()) -> None:
        super().__init__(root)
        self.notes, self.always, self.once = notes, frozenset(always), frozenset(once)

    def forward(self, frames: FrameBatch, *args: Any) -> RefinementResult:
        for frame_id in frames.frame_ids:
            note = self.notes / frame_id
            if frame_id in self.always or (frame_id in self.once and not note.exists()):
                note.touch()
                os.kill(os.getpid(), signal.SIGKILL)
        return super().forward(frames, *args)


class HungryRefiner(QuickRefiner):
    """A `HungryRefiner` needs a gigabyte for a call of several frames, which its process may not have."""

    def forward(self, frames: FrameBatch, *args: Any) -> RefinementResult:
        import resource

        if len(frames) > 1:
            limits = resource.getrlimit(resource.RLIMIT_AS)
            pages_in_use = int(Path("/proc/self/statm").read_text().split()[0])
            resource.setrlimit(resource.RLIMIT_AS, (pages_in_use * resource.getpagesize() + 2**26, limits[1]))
            try:
                torch.ones(2**28)
            finally:
                resource.setrlimit(resource.RLIMIT_AS, limits)
        return super().forward(frames, *args)


class SlowRefiner(QuickRefiner):
    """A `SlowRefiner` sleeps, so that a test has time to kill it."""

    def forward(self, *args: Any) -> RefinementResult:
        time.sleep(0.5)
        return super().forward(*args)
