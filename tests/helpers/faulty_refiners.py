"""This module has quick and slow refiners; they are classes, so that they can be sent to workers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from directshape_torch.config import RefinerConfig
from directshape_torch.io.config_files import load_config
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
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


class SlowRefiner(QuickRefiner):
    """A `SlowRefiner` sleeps, so that a test has time to kill it."""

    def forward(self, *args: Any) -> RefinementResult:
        time.sleep(0.5)
        return super().forward(*args)
