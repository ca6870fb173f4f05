"""This module writes a run as a Rerun recording: frames on one timeline, iterations of refinements on another."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError, MissingDependencyError
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.stereo_matching.disparity import rgb8
from directshape_torch.visualize.drawing import GREEN, GREY, Colour
from directshape_torch.visualize.drawn_car import cars_of_result
from directshape_torch.visualize.painted_cars import ground_grid
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement
from directshape_torch.visualize.residuals import CarResiduals, photometric_colours, silhouette_colours
from directshape_torch.visualize.run_frames import Exporter, RunFrame, frame_numbers

if TYPE_CHECKING:
    import trimesh

# The timelines are numbers of frames, and iterations of all frames in sequence.
_FRAME, _ITERATION = "frame", "iteration"
_STATES_PER_SECOND = 3.0
_LEFT, _RIGHT = "world/cam/image", "right/image"
_RESIDUALS = f"{_LEFT}/silhouette", f"{_RIGHT}/silhouette", f"{_LEFT}/photometric"
_JPEG_QUALITY = 90
_MASK_OPACITY = 0.35
_MOST_LINES = 255
_DOT_PX = 1.6
# This colour differs from the boxes of the result.
_STATE_RGB = (120, 220, 235)


class RerunExporter(Exporter):
    """A `RerunExporter` writes `recording.rrd`: all frames, and with a refiner the states of a repeated refinement.

    Raises:
        MissingDependencyError: Rerun is not installed.
        InputError: there is no data set.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        if self.inputs.dataset is None:
            raise InputError("--data", "the data set of the run, for the pictures of a recording", "nothing")
        _import_rerun()
        self.numbers, self.iteration = frame_numbers(self.inputs.run.frame_ids), 0
        self._stream: _Stream | None = None

    def add(self, frame: RunFrame) -> None:
        loaded, refiner = frame.with_images, self.inputs.refiner
        if self._stream is None:
            # The viewer's views are fitted to the image size of the first frame.
            height, width = loaded.frame.sizes[0].tolist()
            self._stream = _Stream(self.folder / "recording.rrd", (width, height), refiner is not None)
            _log_conventions(self._stream)
        stream, number = self._stream, self.numbers[frame.frame_id]
        stream.at(number, None if refiner is None else self.iteration)
        _log_images(stream, loaded)
        _log_boxes(stream, frame)
        ground = ground_grid(loaded.frame.ground.normal[0], float(loaded.frame.ground.offset[0]))
        stream.log_mesh("world/ground", ground, GREY)
        stream.at(number)
        _clear_cars(stream)
        for index, row in enumerate(frame.refined):
            # All frames of a track use one name.
            track = frame.result.shapes.tracks[row]
            surface, paint = frame.painted.mesh(index)
            stream.log_mesh(f"world/cars/{f'track_{track}' if track else frame.after[row].line}", surface, paint.rgb)
        if refiner is not None:
            self._add_iterations(stream, loaded, refiner, number)

    def _add_iterations(self, stream: _Stream, loaded: LoadedFrame, refiner: DirectShapeRefiner, frame: int) -> None:
        device, dtype = refiner.prior.origin.device, refiner.prior.origin.dtype
        trace = trace_refinement(refiner, loaded.frame.to(device, dtype), loaded.detections.to(device, dtype))
        lines = [one.line_number for one in loaded.detected_objects]
        stream.at(iteration=self.iteration)
        _clear_cars(stream)
        for number in range(len(trace)):
            stream.at(iteration=self.iteration + number)
            _log_state(stream, trace, number, lines)
            _log_costs(stream, trace, number, lines, loaded.frame_id)
        stream.at(frame)
        for row, residuals in trace.residuals(len(trace) - 1).items():
            _log_residuals(stream, lines[row], residuals)
        self.iteration += len(trace)

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if self._stream is not None:
            self._stream.close(keep=error is None)


def _log_conventions(stream: _Stream) -> None:
    """Log the left camera frame as world (x right, y down, z forward, metres), and line numbers as mask classes."""
    stream.log("world", stream.rr.ViewCoordinates.RDF, static=True)
    # The viewer gives each number its own colour.
    classes: list[Any] = [(0, "no car", (0, 0, 0, 0))]
    classes += [(number, f"car {number}") for number in range(1, _MOST_LINES + 1)]
    for entity in (_LEFT, _RIGHT):
        stream.log(f"{entity}/masks", stream.rr.AnnotationContext(classes), static=True)


def _clear_cars(stream: _Stream) -> None:
    """Clear the cars of other frames at the current places."""
    for entity in ("world/cars", "world/boxes/iteration", *_RESIDUALS):
        stream.log(entity, stream.rr.Clear(recursive=True))


def _log_images(stream: _Stream, loaded: LoadedFrame) -> None:
    """Log both images with the camera, and masks whose values are line numbers of the cars, 0 for none."""
    rr, frame, detections = stream.rr, loaded.frame, loaded.detections
    height, width = frame.sizes[0].tolist()
    K_image = frame.camera.K_left[0].double().cpu().numpy().copy()
    # Pixels of Rerun have their corners at whole numbers, ours their centres.
    K_image[:2, 2] += 0.5
    axes = rr.ViewCoordinates.RDF
    stream.log("world/cam", rr.Pinhole(image_from_camera=K_image, resolution=[width, height], camera_xyz=axes))
    sides = ((_LEFT, frame.images_left, detections.mask_left), (_RIGHT, frame.images_right, detections.mask_right))
    for entity, images, masks in sides:
        stream.log(entity, rr.Image(rgb8(images[0])).compress(jpeg_quality=_JPEG_QUALITY))
        numbers = np.zeros(masks.size_hw, dtype=np.uint16)
        for mask, detected in zip(masks, loaded.detected_objects, strict=True):
            numbers[(mask > MASK_THRESHOLD).cpu().numpy()] = detected.line_number
        stream.log(f"{entity}/masks", rr.SegmentationImage(numbers, opacity=_MASK_OPACITY))


def _log_boxes(stream: _Stream, frame: RunFrame) -> None:
    """Log the boxes of the input, of the truth, and of the result, with grey for cars that were not refined."""
    for name, cars in (("before", frame.before or []), ("after", frame.after)):
        corners, colours = np.array([car.corners_cam for car in cars]), [car.colour for car in cars]
        labels = [f"{car.line} {car.status or ''}".rstrip() for car in cars]
        stream.log_boxes(f"world/boxes/{name}", corners, colours, labels)
    truth = np.array(frame.truth_corners_cam)
    stream.log_boxes("world/boxes/truth", truth, [GREEN] * len(truth), ["truth"] * len(truth))


def _log_state(stream: _Stream, trace: RefinementTrace, number: int, lines: Sequence[int]) -> None:
    """Log surfaces, boxes and residuals of the cars in a state; only cars that moved are logged again."""
    rows = trace.rows.tolist()
    cars = cars_of_result(trace.moment(number)[trace.rows], [lines[row] for row in rows])
    corners = np.array([car.corners_cam for car in cars])
    stream.log_boxes("world/boxes/iteration", corners, [_STATE_RGB] * len(cars), [f"{car.line}" for car in cars])
    moved = {row: car for row, car in zip(rows, cars, strict=True) if number in trace.steps_of(row)}
    residuals = trace.residuals(number) if moved else {}
    for row, car in moved.items():
        assert car.surface is not None, "a trace has its prior"
        stream.log_mesh(f"world/cars/{car.line}", car.surface, _STATE_RGB)
        _log_residuals(stream, car.line, residuals[row])


def _log_residuals(stream: _Stream, line: int, residuals: CarResiduals) -> None:
    """Log sampled pixels coloured by residual: silhouettes in both images, photometry in the left one."""
    for name, values in zip(_RESIDUALS, residuals, strict=True):
        colours = photometric_colours if values is residuals.photometric else silhouette_colours
        # Pixels of Rerun have their corners at whole numbers, ours their centres.
        stream.log(f"{name}/{line}", stream.rr.Points2D(values.uv + 0.5, colors=colours(values), radii=_DOT_PX))


def _log_costs(stream: _Stream, trace: RefinementTrace, number: int, lines: Sequence[int], frame_id: str) -> None:
    for row in trace.rows.tolist():
        costs, series = trace.costs[number, row].double().cpu().tolist(), f"{frame_id}/{lines[row]}"
        stream.log(f"cost/{series}", stream.rr.Scalars(sum(costs)))
        for name, cost in zip(trace.result.term_names, costs, strict=True):
            stream.log(f"terms/{series}/{name.replace(' ', '_')}", stream.rr.Scalars(cost))


def _import_rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingDependencyError("rerun-sdk", "viewer", "a Rerun recording") from error
    return rerun


class _Stream:
    """A `_Stream` writes a recording to a temporary file, and moves it to its path when it is complete."""

    def __init__(self, path: Path, size_wh: tuple[int, int], with_iterations: bool) -> None:
        self.rr, self.path = _import_rerun(), path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = self.rr.RecordingStream("directshape", send_properties=False)
        self._stream.save(self._temporary, default_blueprint=_blueprint(size_wh, with_iterations))
        # The time of logging does not belong to the refinement.
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)

    def at(self, frame: int | None = None, iteration: int | None = None) -> None:
        """Set the places on the two timelines for what is logged next; a None is no place on that timeline."""
        self._stream.reset_time()
        for timeline, place in ((_FRAME, frame), (_ITERATION, iteration)):
            if place is not None:
                self._stream.set_time(timeline, sequence=place)

    def log(self, entity: str, *archetypes: Any, static: bool = False) -> None:
        """Log at the current places, or for all times if `static`; values that Rerun does not accept raise."""
        self._stream.log(entity, *archetypes, static=static, strict=True)

    def log_mesh(self, entity: str, mesh: trimesh.Trimesh, colours: NDArray[np.uint8] | Colour) -> None:
        """Log triangles with a colour for each vertex, or one colour for all."""
        of_all = isinstance(colours, tuple)
        made = self.rr.Mesh3D(
            vertex_positions=np.asarray(mesh.vertices, dtype=np.float32),
            triangle_indices=np.asarray(mesh.faces, dtype=np.uint32),
            vertex_normals=np.asarray(mesh.vertex_normals, dtype=np.float32),
            vertex_colors=None if of_all else colours,
            albedo_factor=[*colours, 255] if of_all else None,
        )
        self.log(entity, made)

    def log_boxes(
        self,
        entity: str,
        corners_cam: NDArray[np.floating[Any]],  # (B, 8, 3) in the order of `box_corners`
        colours: Sequence[Colour],
        labels: Sequence[str],
    ) -> None:
        """Log boxes with length, height, width along the axes of their objects."""
        from scipy.spatial.transform import Rotation

        corners = corners_cam.astype(np.float64).reshape(-1, 8, 3)
        axes = corners[:, :1] - corners[:, [3, 4, 1]]
        sizes = np.linalg.norm(axes, axis=2)
        # Axes are rows here, so the matrix is that of the inverse rotation.
        inverse = Rotation.from_matrix(axes / sizes[:, :, None]) if len(axes) else None
        boxes = self.rr.Boxes3D(
            centers=corners.mean(axis=1),
            half_sizes=0.5 * sizes,
            quaternions=[] if inverse is None else [self.rr.Quaternion(xyzw=q) for q in inverse.inv().as_quat()],
            colors=np.array(colours, dtype=np.uint8).reshape(-1, 3),
            labels=list(labels),
            show_labels=False,
            fill_mode=self.rr.components.FillMode.MajorWireframe,
        )
        self.log(entity, boxes)

    def close(self, keep: bool) -> None:
        """Write the end and move the file to its path, or remove it."""
        self._stream.flush()
        self._stream.disconnect()
        if keep:
            os.replace(self._temporary, self.path)
        else:
            self._temporary.unlink(missing_ok=True)


def _blueprint(size_wh: tuple[int, int], with_iterations: bool) -> Any:
    """A layout with a 3D view on the left, images on the right, and with iterations also residuals and costs."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=[0, size_wh[0]], y_range=[0, size_wh[1]])

    def image(name: str, origin: str, *contents: str) -> Any:
        return rrb.Spatial2DView(origin=origin, name=name, contents=list(contents), visual_bounds=bounds)

    views = [image("left: masks and boxes", "world/cam", _LEFT, f"{_LEFT}/masks", "world/boxes/**")]
    seen_right = image("right: masks", "right", _RIGHT, f"{_RIGHT}/masks")
    if with_iterations:
        photometric = image("left: right image less left", _LEFT, _LEFT, f"{_LEFT}/photometric/**")
        silhouettes = [
            image(f"{side}: silhouettes", entity, entity, f"{entity}/silhouette/**")
            for side, entity in (("left", _LEFT), ("right", _RIGHT))
        ]
        views += [photometric, rrb.Tabs(*silhouettes, seen_right)]
        views.append(rrb.TimeSeriesView(origin="cost", name="cost of each car"))
    else:
        views.append(seen_right)
    # The eye is above and behind the camera and looks along the street.
    eye = rrb.EyeControls3D(position=[-7.0, -8.0, -9.0], look_target=[1.0, 1.0, 14.0], eye_up=[0.0, -1.0, 0.0])
    timeline = _ITERATION if with_iterations else _FRAME
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin="world", name="3D", eye_controls=eye), rrb.Vertical(*views)),
        rrb.TimePanel(timeline=timeline, fps=_STATES_PER_SECOND, play_state="paused"),
        collapse_panels=True,
    )
