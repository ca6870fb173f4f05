"""A small finished run to report on: the ray-cast street with frames and classes of any name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from directshape_torch.batch.options import MeshFormat, RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.config_files import load_config
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.kitti_folder import write_data_set

# The model of trust does not know toys that have not converged.
FEW_STEPS = (
    "stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 4}]",
    "acceptance.min_probability_better=0",
)


@dataclass(frozen=True)
class FinishedRun:
    """A data set in KITTI's layout, and the folder of its refinement."""

    root: Path
    out: Path

    @property
    def prior(self) -> PCAShapePrior:
        return PCAShapePrior.load(self.root / "prior.npz")

    @property
    def dataset(self) -> KittiStereoDataset:
        classes = self.folder().classes
        return KittiStereoDataset(self.root, self.root / "detections", self.root / "masks", classes=classes)

    def folder(self, *frames: str) -> RunFolder:
        return RunFolder(self.out, frames or None)


def finished_run(
    folder: Path,
    frame_ids: tuple[str, ...] = ("000000", "000001"),
    *,
    out_name: str = "out",
    car_type: str = "Car",
    meshes: MeshFormat | None = None,
) -> FinishedRun:
    """Write the data set and refine it, a few iterations a car."""
    root, out = folder / "kitti", folder / out_name
    root.mkdir(parents=True)
    write_data_set(root, frame_ids)
    if car_type != "Car":
        for path in (*(root / "detections" / "data").glob("*.txt"), *(root / "training" / "label_2").glob("*.txt")):
            path.write_text(path.read_text().replace("Car ", f"{car_type} "))
    refiner = DirectShapeRefiner(PCAShapePrior.load(root / "prior.npz"), load_config(None, FEW_STEPS))
    dataset = KittiStereoDataset(root, root / "detections", root / "masks", classes=(car_type,))
    refine_dataset(dataset, refiner, out, RefineOptions(meshes=meshes))
    return FinishedRun(root, out)
