"""This module makes runs over the data set of `helpers.kitti_folder` with few iterations for each car."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from directshape_torch.batch.options import RefineOptions, RunObserver
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_summary import RunSummary
from directshape_torch.config import RefinerConfig
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.faulty_refiners import few_steps


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
