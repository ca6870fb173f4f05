"""The finished frames of an output folder of `directshape refine`, ready to be exported."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.batch.run_results import finished_frames, read_run_results
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry.box3d import rotation_about_y
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.refinement_files import result_path, shapes_path
from directshape_torch.io.result_files import ShapeArrays, read_shapes
from directshape_torch.status import Status

COPIED = "copied"
"""The status of lines of other classes, which a refinement leaves as they are."""


@dataclass(frozen=True)
class ExportedObject:
    """One result line with a 3D box, refined or not.

    Attributes:
        line: type, 2D box, score and whatever else the detector said.
        status: name of the `Status` of a car, or "copied".
        car: row in the frame's `ShapeArrays`, -1 for lines that are not in it.
        R_ref_obj: (3, 3) axes of the object (forward, down, left) in `ref`; of a refined car with its tilt.
        bottom_ref: (3,) bottom centre of the box in `ref`, metres.
        hwl: (3,) height, width, length, metres.
    """

    line: KittiObject
    status: str
    car: int
    R_ref_obj: NDArray[np.float64]
    bottom_ref: NDArray[np.float64]
    hwl: NDArray[np.float64]

    @property
    def is_refined(self) -> bool:
        """Whether box and shape come from a refinement."""
        return self.status != COPIED and Status[self.status].is_refined

    @property
    def centre_ref(self) -> NDArray[np.float64]:
        """The centre (3,) of the box in `ref`, metres: half its height above the bottom centre."""
        return np.asarray(self.bottom_ref - 0.5 * self.hwl[0] * self.R_ref_obj[:, 1])


@dataclass(frozen=True)
class RefinedFrame:
    """What a run left of one frame.

    Attributes:
        frame_id: the frame.
        lines: every line of the result file.
        objects: the result lines that have a 3D box, in their order.
        shapes: state and shape of the cars among them.
    """

    frame_id: str
    lines: tuple[KittiObject, ...]
    objects: tuple[ExportedObject, ...]
    shapes: ShapeArrays

    @property
    def refined_cars(self) -> tuple[ExportedObject, ...]:
        """The objects that have a refined shape."""
        return tuple(one for one in self.objects if one.is_refined)


class RunFolder:
    """An output folder of `directshape refine`.

    Args:
        path: holds `summary.json`, `data` and `shapes`.
        frames: ids to export, "000107" or as a number with zeros or without; default all that are finished.

    Raises:
        DataFormatError: it is no such folder.
        InputError: nothing is finished, or not a frame that is asked for.
    """

    def __init__(self, path: Path | str, frames: Iterable[str | int] | None = None) -> None:
        self.path = Path(path)
        self.manifest = read_run_results(self.path)
        self.frame_ids = tuple(finished_frames(self.path, self.manifest, frames))
        if not self.frame_ids:
            raise InputError("frames", f"finished frames of {self.path}", "none")

    @property
    def classes(self) -> tuple[str, ...]:
        """The types of objects that were refined."""
        return tuple(self.setting("classes"))

    def setting(self, name: str) -> Any:
        """A setting of the run, by its name at the top of `config`.

        Raises:
            DataFormatError: the summary does not have it.
        """
        if name not in self.manifest.config:
            raise DataFormatError(self.path / "summary.json", f"has no setting {name!r}")
        return self.manifest.config[name]

    def read(self, frame_id: str) -> RefinedFrame:
        """The objects of a finished frame.

        Raises:
            DataFormatError: a file is missing or damaged, or the two files of the frame do not fit together.
        """
        path = result_path(self.path, frame_id)
        shapes = read_shapes(shapes_path(self.path, frame_id))
        lines = read_objects(path)
        car_of_line = {int(number): car for car, number in enumerate(shapes.input_lines)}
        if not set(car_of_line) <= {line.line_number for line in lines}:
            raise DataFormatError(path, f"lacks lines of {shapes_path(self.path, frame_id)}", cure="refine it again")
        objects = [_exported(line, car_of_line.get(line.line_number, -1), shapes) for line in lines if line.has_box_3d]
        return RefinedFrame(frame_id, tuple(lines), tuple(objects), shapes)


def _nearest_rotation(R: NDArray[Any]) -> NDArray[np.float64]:
    """A rotation kept in float32 is one to seven digits; other programs check more of them."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R.astype(np.float64)).as_matrix())


def _exported(line: KittiObject, car: int, shapes: ShapeArrays) -> ExportedObject:
    if car < 0:
        R_ref_obj = rotation_about_y(torch.tensor(line.rotation_y, dtype=torch.float64)).numpy()
        return ExportedObject(line, COPIED, car, R_ref_obj, np.array(line.location_ref), np.array(line.hwl))
    return ExportedObject(
        line=line,
        status=shapes.statuses[car],
        car=car,
        R_ref_obj=_nearest_rotation(shapes.T_ref_obj[car, :3, :3]),
        bottom_ref=shapes.boxes_location_ref[car].astype(np.float64),
        hwl=shapes.boxes_hwl[car].astype(np.float64),
    )
