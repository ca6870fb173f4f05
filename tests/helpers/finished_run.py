"""A small finished run: two frames of two ellipsoid cars and a pedestrian, refined for a few iterations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from directshape_torch.cli.main import main
from directshape_torch.export.frame_source import ExportInputs
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.kitti_folder import write_data_set

FRAMES = ("000000", "000001")


@dataclass(frozen=True)
class FinishedRun:
    """The data set, the output folder, and the shapes that both are made of."""

    root: Path
    out: Path
    prior: PCAShapePrior

    def inputs(self, with_images: bool = True, **options: object) -> ExportInputs:
        """What an export may use."""
        dataset = KittiStereoDataset(self.root, self.root / "detections", self.root / "masks") if with_images else None
        return ExportInputs(PCAShapePrior.load(self.root / "prior.npz"), dataset, self.root, **options)  # type: ignore[arg-type]

    @property
    def folder(self) -> RunFolder:
        """The run as exports read it."""
        return RunFolder(self.out)


def make_run(folder: Path) -> FinishedRun:
    """Write a data set to `folder/kitti` and refine it to `folder/out`."""
    root, out = folder / "kitti", folder / "out"
    root.mkdir()
    prior = write_data_set(root, FRAMES)
    words = ["refine", "--data", root, "--detections", root / "detections", "--masks", root / "masks", "--out", out]
    options = [
        "--prior",
        root / "prior.npz",
        "--device",
        "cpu",
        "--rig",
        "none",
        "--set",
        "stages=[{max_iterations: 6}]",
    ]
    assert main([str(word) for word in (*words, *options)]) == 0
    return FinishedRun(root, out, prior)
