"""This module makes a small finished run with frames and classes of any name, two ellipsoid cars and a pedestrian."""

from __future__ import annotations

import base64
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.visualize.run_frames import RunInputs
from helpers.kitti_folder import write_data_set
from helpers.quick_runs import dataset, refiner

FRAMES = ("000000", "000001")


@dataclass(frozen=True)
class FinishedRun:
    """A `FinishedRun` is a data set in KITTI's layout with the folder of its refinement."""

    root: Path
    out: Path

    @property
    def prior(self) -> PCAShapePrior:
        return PCAShapePrior.load(self.root / "prior.safetensors")

    @property
    def dataset(self) -> StereoDataset:
        return dataset(self.root, classes=self.folder().classes)

    def folder(self, *frames: str) -> RunFolder:
        return RunFolder(self.out, frames or None)

    def with_tracks(self, folder: Path, tracks: tuple[str, str], parts: Sequence[Sequence[int]]) -> RunFolder:
        """A copy of the run whose cars have tracks, with `parts` for each frame."""
        shutil.copytree(self.out, folder)
        for frame_id, part in zip(FRAMES, parts, strict=True):
            path = folder / "shapes" / f"{frame_id}.npz"
            write_shapes(path, replace(read_shapes(path), tracks=tracks, track_parts=np.array(part)))
        return RunFolder(folder)

    def state(self, frame_id: str) -> dict[str, NDArray[Any]]:
        """The content of the npz of a frame."""
        with np.load(self.out / "shapes" / f"{frame_id}.npz", allow_pickle=False) as file:
            return dict(file)

    def P_left(self, frame_id: str) -> NDArray[np.float64]:
        """The left camera (3, 4) of the calibration file."""
        words = (self.root / f"training/calib/{frame_id}.txt").read_text().split("\n")[0].split()
        return np.array(words[1:], float).reshape(3, 4)

    def inputs(
        self, run: RunFolder | None = None, *, with_images: bool = True, has_detections: bool = True
    ) -> RunInputs:
        """The inputs of a page or an export, of all frames or of those of a folder."""
        dataset = self.dataset if with_images else None
        return RunInputs(self.folder() if run is None else run, self.prior, dataset, has_detections)


def finished_run(
    folder: Path,
    frame_ids: tuple[str, ...] = FRAMES,
    *,
    out_name: str = "out",
    car_type: str = "Car",
) -> FinishedRun:
    """Write a data set to `folder/kitti` and refine it to `folder/out`."""
    root = folder / "kitti"
    root.mkdir(parents=True)
    write_data_set(root, frame_ids)
    if car_type != "Car":
        for path in (*(root / "detections" / "data").glob("*.txt"), *(root / "training" / "label_2").glob("*.txt")):
            path.write_text(path.read_text().replace("Car ", f"{car_type} "))
    refine_dataset(dataset(root, classes=(car_type,)), refiner(root), folder / out_name)
    return FinishedRun(root, folder / out_name)


def by_place(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points sorted by their positions along three directions that no box is aligned with."""
    return points[np.argsort(points @ np.array([1.0, 0.0123, 0.345]))]


def unpacked(text: str) -> NDArray[np.int64]:
    """The numbers of a mesh on a page, as `mesh.js` reads them."""
    return np.cumsum(np.frombuffer(zlib.decompress(base64.b64decode(text)), "<i4").astype(np.int64))
