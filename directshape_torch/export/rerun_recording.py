"""A run as a Rerun recording: frames on one timeline, the iterations of their refinements on another.

A frame is its images, masks, boxes, surfaces, ground; an iteration the surfaces, boxes, residuals and costs of a state.
"""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.export.coco3d_file import image_numbers
from directshape_torch.export.frame_source import Exporter, FrameSource
from directshape_torch.export.painted_cars import PaintedFrame
from directshape_torch.export.rerun_stream import RerunStream, import_rerun
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.status import Status
from directshape_torch.visualize.drawing import BLUE, GREEN, GREY, ORANGE, picture_of
from directshape_torch.visualize.ground_grid import ground_grid
from directshape_torch.visualize.inspection.pixel_residuals import CarResiduals, PixelResiduals, car_residuals
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement

LEFT, RIGHT = "world/cam/image", "right/image"
_RESIDUALS = f"{LEFT}/silhouette", f"{RIGHT}/silhouette", f"{LEFT}/photometric"
_JPEG_QUALITY = 90
_MASK_OPACITY = 0.35
_MOST_LINES = 255
# -log 0.01: what a pixel pays whose mask is certain and wrong.
_WORST_SILHOUETTE = 4.6
_WORST_GREY_LEVELS = 30.0
_LOST_RGB = (130, 130, 130)
_DOT_PX = 1.6
# Not the colour of the boxes that the run ended with.
_STATE_RGB = (120, 220, 235)


class RerunExporter(Exporter):
    """All frames in one recording.

    Args:
        path: of the .rrd file.
        run: the frames that will come.
        with_iterations: whether frames will come with a refiner.

    Raises:
        MissingDependencyError: Rerun is not installed.
    """

    def __init__(self, path: Path, run: RunFolder, with_iterations: bool) -> None:
        import_rerun()
        self.path, self.with_iterations = path, with_iterations
        self.numbers: Mapping[str, int] = image_numbers(run.frame_ids)
        self.iteration = 0
        self._stream: RerunStream | None = None

    def add(self, source: FrameSource) -> None:
        """Log a frame; with a refiner also the states that it goes through when it refines the frame again.

        Raises:
            InputError: the frame has no images.
        """
        stream, frame = self._begun(source), self.numbers[source.frame_id]
        refiner = source.inputs.refiner
        stream.at(frame, None if refiner is None else self.iteration)
        _log_frame(stream, source)
        stream.at(frame)
        _clear_cars(stream)
        _log_painted_cars(stream, source.painted)
        if refiner is not None:
            self._add_iterations(stream, source, refiner, frame)

    def finish(self) -> None:
        """Move the file to its place."""
        if self._stream is not None:
            self._stream.close()
            # What is in its place is not for `abandon`.
            self._stream = None

    def abandon(self) -> None:
        """Leave no file behind."""
        if self._stream is not None:
            self._stream.abandon()

    def _begun(self, source: FrameSource) -> RerunStream:
        """The recording, begun with the first frame: its images say what the viewer's views are fitted to."""
        if self._stream is None:
            height, width = source.with_images("the pictures of a recording").frame.sizes[0].tolist()
            self._stream = RerunStream(self.path, (width, height), self.with_iterations)
            _log_conventions(self._stream)
        return self._stream

    def _add_iterations(
        self, stream: RerunStream, source: FrameSource, refiner: DirectShapeRefiner, frame: int
    ) -> None:
        loaded = source.with_images("the refinement of its frames")
        trace = _trace(source, refiner)
        log = _IterationLog(stream, loaded, trace)
        stream.at(iteration=self.iteration)
        _clear_cars(stream)
        for number in range(len(trace)):
            stream.at(iteration=self.iteration + number)
            log.log_state(number)
        stream.at(frame)
        residuals = car_residuals(trace, len(trace) - 1)
        for car in log.cars:
            log.log_residuals(car, residuals[car])
        self.iteration += len(trace)


def _trace(source: FrameSource, refiner: DirectShapeRefiner) -> RefinementTrace:
    loaded = source.with_images("the refinement of its frames")
    device, dtype = refiner.prior.origin.device, refiner.prior.origin.dtype
    return trace_refinement(refiner, loaded.frame.to(device, dtype), loaded.detections.to(device, dtype))


def _log_conventions(stream: RerunStream) -> None:
    """The world is the left camera frame: x right, y down, z forward, metres. Masks have the numbers of lines."""
    stream.log("world", stream.rr.ViewCoordinates.RDF, static=True)
    context = stream.rr.AnnotationContext([(0, "no car", (0, 0, 0, 0)), *_car_classes()])
    for entity in (LEFT, RIGHT):
        stream.log(f"{entity}/masks", context, static=True)


def _log_frame(stream: RerunStream, source: FrameSource) -> None:
    """Everything of a frame but its iterations, at the present places of the timelines."""
    loaded = source.with_images("the pictures of a recording")
    _log_images(stream, loaded)
    _log_masks(stream, loaded)
    offset = loaded.frame.camera.t_cam_ref[0].double()
    before = loaded.detected_objects if source.inputs.has_detections else []
    _log_boxes_of_lines(stream, "world/boxes/before", before, offset, ORANGE)
    labels = [one for one in loaded.labels or [] if one.has_box_3d and one.type in set(source.run.classes)]
    _log_boxes_of_lines(stream, "world/boxes/truth", labels, offset, GREEN)
    _log_refined_boxes(stream, source, offset.numpy())
    ground = ground_grid(loaded.frame.ground.normal[0], float(loaded.frame.ground.offset[0]))
    stream.log_mesh("world/ground", ground.vertices, ground.faces, colour=GREY)


def _clear_cars(stream: RerunStream) -> None:
    """Take away what the cars of other frames left at the present places."""
    for entity in ("world/cars", "world/boxes/iteration", *_RESIDUALS):
        stream.log(entity, stream.rr.Clear(recursive=True))


def _log_painted_cars(stream: RerunStream, painted: PaintedFrame) -> None:
    """The refined surfaces with the image's colours, under one name through all frames of a track."""
    for index, one in enumerate(painted.objects):
        surface, paint = painted.mesh(index)
        track = painted.frame.shapes.tracks[one.car]
        entity = f"world/cars/track_{track}" if track else f"world/cars/{one.line.line_number}"
        stream.log_mesh(entity, surface.vertices, surface.faces, surface.vertex_normals, paint.rgb)


def _car_classes() -> list[tuple[int, str, tuple[int, int, int, int]]]:
    """Numbers, names and colours of cars; hues a golden angle apart differ as much as they can."""
    classes = []
    for number in range(1, _MOST_LINES + 1):
        red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb((number * 0.618) % 1, 0.8, 1.0))
        classes.append((number, f"car {number}", (red, green, blue, 255)))
    return classes


def _log_boxes_of_lines(
    stream: RerunStream, entity: str, lines: Sequence[KittiObject], t_cam_ref: Tensor, colour: tuple[int, int, int]
) -> None:
    """The boxes of lines of a KITTI file, labelled with their numbers."""
    hwl = np.array([one.hwl for one in lines], dtype=np.float64)
    labels = [f"{one.line_number}" for one in lines]
    stream.log_boxes(entity, poses_cam(lines, t_cam_ref).numpy(), hwl, [colour] * len(lines), labels)


def _log_refined_boxes(stream: RerunStream, source: FrameSource, t_cam_ref: NDArray[np.float64]) -> None:
    """The boxes of the result; those that were not refined are grey."""
    cars = [one for one in source.refined.objects if one.car >= 0]
    T_cam_box = np.tile(np.eye(4), (len(cars), 1, 1))
    for T, one in zip(T_cam_box, cars, strict=True):
        T[:3, :3], T[:3, 3] = one.R_ref_obj, one.bottom_ref + t_cam_ref
    colours = [BLUE if one.is_refined else GREY for one in cars]
    labels = [f"{one.line.line_number} {one.status}" for one in cars]
    stream.log_boxes("world/boxes/after", T_cam_box, np.array([one.hwl for one in cars]), colours, labels)


def _log_images(stream: RerunStream, loaded: LoadedFrame) -> None:
    rr, frame = stream.rr, loaded.frame
    height, width = frame.sizes[0].tolist()
    K_image = frame.camera.K_left[0].double().cpu().numpy().copy()
    # Rerun's pixels have their corners at whole numbers, ours their centres.
    K_image[:2, 2] += 0.5
    axes = rr.ViewCoordinates.RDF
    stream.log("world/cam", rr.Pinhole(image_from_camera=K_image, resolution=[width, height], camera_xyz=axes))
    for entity, image in ((LEFT, frame.images_left[0]), (RIGHT, frame.images_right[0])):
        stream.log(entity, rr.EncodedImage(contents=_jpeg(image), media_type="image/jpeg"))


def _jpeg(image: Tensor) -> bytes:
    """(3, H, W) in [0, 1] as JPEG."""
    import cv2

    rgb = picture_of(image)
    encoded, content = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not encoded:
        raise DataFormatError("image", f"OpenCV cannot encode shape {rgb.shape} as JPEG")
    return content.tobytes()


def _log_masks(stream: RerunStream, loaded: LoadedFrame) -> None:
    """Pixels of each car by the number of its line, 0 for none."""
    rr, detections = stream.rr, loaded.detections
    for entity, masks in ((LEFT, detections.mask_left), (RIGHT, detections.mask_right)):
        numbers = np.zeros(tuple(masks.shape[1:]), dtype=np.uint16)
        for mask, detected in zip(masks, loaded.detected_objects, strict=True):
            numbers[(mask > MASK_THRESHOLD).cpu().numpy()] = detected.line_number
        stream.log(f"{entity}/masks", rr.SegmentationImage(numbers, opacity=_MASK_OPACITY))


class _IterationLog:
    """Logs the states of the cars of one frame."""

    def __init__(self, stream: RerunStream, loaded: LoadedFrame, trace: RefinementTrace) -> None:
        self.stream, self.loaded, self.trace = stream, loaded, trace
        self.cars = [int(row) for row in trace.rows.tolist()]

    def line(self, car: int) -> int:
        """The number of a car's line in the detection file."""
        return self.loaded.detected_objects[car].line_number

    def log_state(self, number: int) -> None:
        """Surfaces, boxes, residuals and costs of all cars in a state; what a car shares with the one before stays."""
        self._log_boxes(number)
        moved = [car for car in self.cars if number in self.trace.steps_of(car)]
        residuals = car_residuals(self.trace, number) if moved else {}
        for car in self.cars:
            if car in moved:
                self._log_surface(car, number)
                self.log_residuals(car, residuals[car])
            self._log_costs(car, number)

    def log_residuals(self, car: int, residuals: CarResiduals) -> None:
        """Sampled pixels coloured by what they cost: silhouettes in both images, photometry in the left one."""
        for name, values, colours in zip(_RESIDUALS, residuals, (_heat, _heat, _blue_red), strict=True):
            # Rerun's pixels have their corners at whole numbers, ours their centres.
            dots = self.stream.rr.Points2D(values.uv + 0.5, colors=colours(values), radii=_DOT_PX)
            self.stream.log(f"{name}/{self.line(car)}", dots)

    def _log_surface(self, car: int, number: int) -> None:
        state, prior = self.trace.states[number], self.trace.result.prior
        values = prior.values(state.code[car : car + 1])[0]
        surface = sdf_to_mesh(values, prior.origin, prior.spacing_m, se3.inverse(state.T_obj_cam[car]))
        entity = f"world/cars/{self.line(car)}"
        self.stream.log_mesh(entity, surface.vertices, surface.faces, surface.vertex_normals, colour=_STATE_RGB)

    def _log_costs(self, car: int, number: int) -> None:
        costs = self.trace.costs[number, car].double().cpu().tolist()
        series = f"{self.loaded.frame_id}/{self.line(car)}"
        self.stream.log(f"cost/{series}", self.stream.rr.Scalars(sum(costs)))
        for name, cost in zip(self.trace.result.term_names, costs, strict=True):
            self.stream.log(f"terms/{series}/{name.replace(' ', '_')}", self.stream.rr.Scalars(cost))

    def _log_boxes(self, number: int) -> None:
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
        labels = [f"{self.line(car)}" for car in self.cars]
        self.stream.log_boxes("world/boxes/iteration", T_cam_box, hwl, [_STATE_RGB] * len(labels), labels)


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
