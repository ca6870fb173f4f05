"""This module makes runs over the data set of `helpers.kitti_folder` with few iterations for each car.

Its refiners are classes, so that they can be sent to workers.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from directshape_torch.batch.options import RefineOptions, RunObserver
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_summary import RunSummary
from directshape_torch.config import RefinerConfig
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset
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


def dataset(root: Path, **options: Any) -> StereoDataset:
    return open_dataset("kitti", root, root / "detections", root / "masks", **options)


def refiner(root: Path, config: RefinerConfig | None = None) -> DirectShapeRefiner:
    return DirectShapeRefiner(PCAShapePrior.load(root / "prior.safetensors"), config or few_steps())


def refine(
    root: Path,
    out: Path,
    made: DirectShapeRefiner | None = None,
    *,
    config: RefinerConfig | None = None,
    observer: RunObserver | None = None,
    fresh: bool = False,
    **options: Any,
) -> RunSummary:
    """Refine the data set with the given refiner, or with a quick one."""
    made = made or refiner(root, config)
    return refine_dataset(dataset(root), made, out, RefineOptions(**options), observer, fresh=fresh)


def result_files(folder: Path) -> dict[str, bytes]:
    """All files by name, except those about the run itself."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "timings.json"
    }
