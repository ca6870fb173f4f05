"""The iterations of a refinement in a Rerun recording: surfaces, boxes, residuals and costs of every state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.export.rerun_scene import LEFT, RIGHT, boxes, mesh
from directshape_torch.export.rerun_stream import RerunStream
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.status import Status
from directshape_torch.visualize.inspection.residual_figure import (
    CarResiduals,
    PixelResiduals,
    car_residuals,
)
from directshape_torch.visualize.refinement_trace import RefinementTrace

# -log 0.01: what a pixel pays whose mask is certain and wrong.
_WORST_SILHOUETTE = 4.6
_WORST_GREY_LEVELS = 30.0
_LOST_RGB = (130, 130, 130)
_DOT_PX = 1.6
# Not the colour of the boxes that the run ended with.
_STATE_RGB = (120, 220, 235)


class IterationLog:
    """Logs the states of the cars of one frame.

    Args:
        stream: the recording.
        loaded: the frame.
        trace: of its refinement.
    """

    def __init__(self, stream: RerunStream, loaded: LoadedFrame, trace: RefinementTrace) -> None:
        self.stream, self.loaded, self.trace = stream, loaded, trace
        self.cars = [int(row) for row in trace.rows.tolist()]

    def line(self, car: int) -> int:
        """The number of a car's line in the detection file."""
        return self.loaded.detected_objects[car].line_number

    def log_state(self, number: int) -> None:
        """Surfaces, boxes, residuals and costs of all cars in a state; what a car shares with the one before stays."""
        self.stream.log("world/boxes/iteration", self._boxes(number))
        moved = [car for car in self.cars if number in self.trace.steps_of(car)]
        residuals = car_residuals(self.trace, number) if moved else {}
        for car in self.cars:
            if car in moved:
                self._log_surface(car, number)
                self.log_residuals(car, residuals[car])
            self._log_costs(car, number)

    def log_residuals(self, car: int, residuals: CarResiduals) -> None:
        """Sampled pixels coloured by what they cost: silhouettes in both images, photometry in the left one."""
        names = f"{LEFT}/silhouette", f"{RIGHT}/silhouette", f"{LEFT}/photometric"
        for name, values, colours in zip(names, residuals, (_heat, _heat, _blue_red), strict=True):
            # Rerun's pixels have their corners at whole numbers, ours their centres.
            dots = self.stream.rr.Points2D(values.uv + 0.5, colors=colours(values), radii=_DOT_PX)
            self.stream.log(f"{name}/{self.line(car)}", dots)

    def _log_surface(self, car: int, number: int) -> None:
        state, prior = self.trace.states[number], self.trace.result.prior
        values = prior.values(state.code[car : car + 1])[0]
        surface = sdf_to_mesh(values, prior.origin, prior.spacing_m, se3.inverse(state.T_obj_cam[car]))
        content = mesh(self.stream, surface.vertices, surface.faces, normals=surface.vertex_normals, colour=_STATE_RGB)
        self.stream.log(f"world/cars/{self.line(car)}", content)

    def _log_costs(self, car: int, number: int) -> None:
        costs = self.trace.costs[number, car].double().cpu().tolist()
        series = f"{self.loaded.frame_id}/{self.line(car)}"
        self.stream.log(f"cost/{series}", self.stream.rr.Scalars(sum(costs)))
        for name, cost in zip(self.trace.result.term_names, costs, strict=True):
            self.stream.log(f"terms/{series}/{name.replace(' ', '_')}", self.stream.rr.Scalars(cost))

    def _boxes(self, number: int) -> Any:
        """Boxes measured on the zero level of the state, as those of a result are."""
        state = self.trace.states[number]
        # A result shows the detector's box of a car that it gives its input back; here is what was tried.
        status = torch.full_like(self.trace.result.status_code, Status.converged.code)
        T_cam_obj = se3.inverse(state.T_obj_cam)
        then = replace(self.trace.result, T_cam_obj=T_cam_obj, code=state.code, status_code=status).boxes()
        rows = self.trace.rows
        location_cam = (then.location_ref + self.trace.result.t_cam_ref)[rows].double().cpu()
        T_cam_box = pose_from_kitti(location_cam, then.rotation_y[rows].double().cpu()).numpy()
        hwl = then.dimensions_hwl[rows].double().cpu().numpy()
        centres = T_cam_box[:, :3, 3] - 0.5 * hwl[:, :1] * T_cam_box[:, :3, 1]
        labels = [f"{self.line(car)}" for car in self.cars]
        return boxes(self.stream, centres, T_cam_box[:, :3, :3], hwl, [_STATE_RGB] * len(labels), labels)


def _heat(values: PixelResiduals) -> NDArray[np.uint8]:
    """Black where nothing is wrong, over red to yellow where the mask is certain and wrong."""
    share = np.clip(values.value / _WORST_SILHOUETTE, 0, 1)[:, None]
    return np.asarray((255 * np.clip(share * [2.0, 2.0, 0.0] - [0.0, 1.0, 0.0], 0, 1)).astype(np.uint8))


def _blue_red(values: PixelResiduals) -> NDArray[np.uint8]:
    """Blue where the right image is darker, white where they agree, red where it is brighter; grey where lost."""
    share = np.clip(values.value / _WORST_GREY_LEVELS, -1, 1)[:, None]
    white_to_red, white_to_blue = 1 - np.maximum(share, 0) * [0, 1, 1], 1 - np.maximum(-share, 0) * [1, 1, 0]
    colours = (255 * np.minimum(white_to_red, white_to_blue)).astype(np.uint8)
    colours[values.lost] = _LOST_RGB
    return np.asarray(colours)
