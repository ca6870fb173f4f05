"""This module gives the frames of a run with their inputs, as far as these are unchanged, to pages and exporters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.kitti_labels import KittiObject, box_corners_cam, poses_cam
from directshape_torch.io.run_folder import FrameResult, RunFolder, result_path, shapes_path
from directshape_torch.io.run_manifest import hash_file, hash_prior
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset
from directshape_torch.refinement.quality import is_front_known
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import Array
from directshape_torch.visualize.drawn_car import (
    DrawnCar,
    cars_after,
    corners_cam,
    mean_car,
    true_corners,
)
from directshape_torch.visualize.painted_cars import PaintedFrame

if TYPE_CHECKING:
    import trimesh

_WORDS = {"image_left": "left image", "image_right": "right image", "ground_plane": "ground plane"}


@dataclass(frozen=True)
class RunInputs:
    """A `RunInputs` is a run with the other inputs of a page or an export.

    Raises:
        InputError: the prior is not the prior of the run.
    """

    run: RunFolder
    prior: ShapePrior | None = None  # shape prior of the run; None: no shapes
    # Images, calibrations, masks and detections of the run's frames; None: no pictures and no colours.
    dataset: StereoDataset | None = None
    has_detections: bool = True  # whether the data set has the detections of the run, not substitutes
    # Inputs that could not be used, with the frames.
    problems: dict[str, set[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        wanted = self.run.manifest.sha256["prior"]
        if self.prior is not None and hash_prior(self.prior) != wanted:
            raise InputError("--prior", f"the prior of the run (sha256 {wanted[:12]})", "another one")

    @cached_property
    def mean(self) -> trimesh.Trimesh | None:
        """The mean shape in its object frame."""
        return None if self.prior is None else mean_car(self.prior)


class RunFrame:
    """A `RunFrame` is one finished frame of a run; its parts are read on first use.

    Raises:
        DataFormatError: a file of the run is missing or damaged.
    """

    def __init__(self, inputs: RunInputs, frame_id: str) -> None:
        self.inputs, self.frame_id = inputs, frame_id

    @cached_property
    def result(self) -> FrameResult:
        """Boxes, states and shapes."""
        return self.inputs.run.read(self.frame_id)

    @cached_property
    def detections(self) -> list[KittiObject] | None:
        """The lines of the refined cars in the detection file, or None if it is not available or changed."""
        dataset = self.inputs.dataset
        if dataset is None or not self.inputs.has_detections:
            return None
        path = dataset.layout.files(self.frame_id).detections
        if path is None or not self._are_unchanged({"detections": path}):
            return None
        run, lines = self.inputs.run, dataset.objects(self.frame_id)
        cars = [one for one in lines if one.type in run.classes and one.has_box_3d]
        if len(cars) != len(self.result.cars):
            raise DataFormatError(shapes_path(run.path, self.frame_id), "does not have the cars of its detection file")
        return cars

    @property
    def labels(self) -> list[KittiObject] | None:
        """The ground truth; the run does not read it, so no hash can show changes."""
        dataset = self.inputs.dataset
        return None if dataset is None else dataset.layout.files(self.frame_id).read_labels()

    @cached_property
    def loaded(self) -> LoadedFrame | None:
        """Images, camera, ground and masks, or None if they are not available or changed."""
        dataset = self.inputs.dataset
        if dataset is None:
            return None
        try:
            files = dataset.input_files(self.frame_id)
        except DataFormatError as error:
            # The list of a frame's masks is itself a file.
            self._note(f"{error.path.name} not found or damaged")
            found = dataset.layout.files(self.frame_id)
            self._are_unchanged({"image_left": found.left, "image_right": found.right})
            return None
        # Substitutes of `detections` cannot have the hash of the run.
        kept = {role: path for role, path in files.items() if role != "detections" or self.inputs.has_detections}
        return dataset.load(self.frame_id) if self._are_unchanged(kept) else None

    @property
    def images(self) -> LoadedFrame | None:
        """The frame with its images, as `loaded` has it; exports refuse files that have changed since the run.

        Raises:
            DataFormatError: the files of the data set are not those of the run.
        """
        if self.loaded is None and self.inputs.dataset is not None:
            problems = ", ".join(sorted(self.inputs.problems))
            raise DataFormatError(result_path(self.inputs.run.path, self.frame_id), f"cannot be exported: {problems}")
        return self.loaded

    @property
    def with_images(self) -> LoadedFrame:
        """The frame with its images, where the caller has made sure that the run has its data set; see `images`."""
        assert self.images is not None, "no data set"
        return self.images

    @cached_property
    def t_cam_ref(self) -> Tensor:
        """`x_cam = x_ref + t_cam_ref` (3,), float64, from the states; zero for a frame without cars."""
        shapes = self.result.shapes
        if not len(shapes.input_lines):
            return torch.zeros(3, dtype=torch.float64)
        offset = shapes.T_cam_obj.astype(np.float64)[:, :3, 3] - shapes.T_ref_obj.astype(np.float64)[:, :3, 3]
        return torch.from_numpy(np.median(offset, axis=0))

    @cached_property
    def before(self) -> list[DrawnCar] | None:
        """The cars before the refinement, or None without detections."""
        if self.detections is None:
            return None
        # The mean shape stands at the pose of each detection, with the detection's box.
        code, mean = np.zeros(self.result.shapes.codes.shape[1]), self.inputs.mean
        T_cam_obj = poses_cam(self.detections, self.t_cam_ref).numpy()
        states = zip(T_cam_obj, box_corners_cam(self.detections, self.t_cam_ref).numpy(), self.detections, strict=True)
        return [DrawnCar(T, corners, code, mean, line.line_number) for T, corners, line in states]

    @cached_property
    def after(self) -> list[DrawnCar]:
        """The cars after the refinement."""
        shapes = self.result.shapes
        location_ref, rotation_y, hwl = (
            torch.from_numpy(x) for x in (shapes.boxes_location_ref, shapes.boxes_rotation_y, shapes.boxes_hwl)
        )
        corners = corners_cam(location_ref, rotation_y, hwl, self.t_cam_ref)
        of_shapes = (shapes.input_lines.tolist(), shapes.statuses, shapes.T_cam_obj, shapes.codes)
        fronts = [is_front_known(each) for each in shapes.probabilities_heading.tolist()]
        return cars_after(*of_shapes, corners, fronts, self.before, self.inputs.prior)

    @cached_property
    def refined(self) -> list[int]:
        """Rows of the refined cars, which are the cars of `painted`, in the same order."""
        return [row for row, car in enumerate(self.after) if car.is_refined]

    @cached_property
    def painted(self) -> PaintedFrame:
        """Surfaces with colours.

        Raises:
            InputError: the shape prior of the run was not given.
        """
        if self.inputs.prior is None:
            raise InputError("--prior", "the shape prior of the run", "nothing")
        return PaintedFrame([self.after[row] for row in self.refined], self.inputs.prior, self.images)

    @property
    def truth_corners_cam(self) -> list[Array]:
        """Corners (8, 3) of the labelled boxes of the refined classes."""
        return true_corners(self.labels, self.inputs.run.classes, self.t_cam_ref)

    def _are_unchanged(self, files: Mapping[str, Path]) -> bool:
        """Whether the files are those that the run read; problems are noted."""
        found = [self._problem(role, path) for role, path in files.items()]
        for problem in filter(None, found):
            self._note(problem)
        return not any(found)

    def _problem(self, role: str, path: Path) -> str | None:
        name, known = _WORDS.get(role, role), self.result.record.inputs.get(role)
        if role.startswith("masks_"):
            name = "masks"
        if not path.is_file():
            return f"{name} not found"
        return f"{name} not used: the file has changed since the run" if known not in (None, hash_file(path)) else None

    def _note(self, problem: str) -> None:
        self.inputs.problems.setdefault(problem, set()).add(self.frame_id)
