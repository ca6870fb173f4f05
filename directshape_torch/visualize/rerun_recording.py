"""This module writes a run as a Rerun recording, with its frames on a timeline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from directshape_torch.errors import InputError, MissingDependencyError
from directshape_torch.files.atomic_files import replaced_file
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.stereo_matching.disparity import rgb8
from directshape_torch.visualize.drawing import GREEN, GREY, Array, Colour
from directshape_torch.visualize.painted_cars import ground_grid
from directshape_torch.visualize.run_frames import RunFrame, RunInputs

if TYPE_CHECKING:
    import trimesh
    from rerun import RecordingStream

_TIMELINE, _FRAMES_PER_SECOND = "frame", 3.0
_LEFT, _RIGHT = "world/cam/image", "right/image"
_JPEG_QUALITY = 90
_MASK_OPACITY = 0.35
_MOST_LINES = 255


@contextmanager
def recording(path: Path, inputs: RunInputs) -> Iterator[Callable[[RunFrame], None]]:
    """A function that adds a frame to a recording, which is written when the body ends.

    Raises:
        MissingDependencyError: Rerun is not installed.
        InputError: there is no data set.
    """
    if inputs.dataset is None:
        raise InputError("--data", "the data set of the run, for the pictures of a recording", "nothing")
    try:
        import rerun as rr
    except ImportError as error:
        raise MissingDependencyError("rerun-sdk", "viewer", "a Rerun recording") from error
    numbers = frame_numbers(inputs.run.frame_ids)
    stream = rr.RecordingStream("directshape", send_properties=False)
    with replaced_file(path) as file:
        try:
            # The viewer's views are fitted to the image size of the first frame.
            height, width = RunFrame(inputs, inputs.run.frame_ids[0]).with_images.frame.sizes[0].tolist()
            stream.save(file.name, default_blueprint=_blueprint((width, height)))
            # The time of logging does not belong to the refinement.
            stream.set_log_time_enabled(False)
            stream.set_log_tick_enabled(False)
            _log_conventions(stream)
            yield lambda frame: _add(stream, frame, numbers[frame.frame_id])
        finally:
            stream.flush()
            stream.disconnect()


def _add(stream: RecordingStream, frame: RunFrame, number: int) -> None:
    """Log everything of a frame at its number on the timeline."""
    import rerun as rr

    loaded = frame.with_images
    stream.set_time(_TIMELINE, sequence=number)
    _log_images(stream, loaded)
    _log_boxes(stream, frame)
    ground = ground_grid(loaded.frame.ground.normal[0], float(loaded.frame.ground.offset[0]))
    stream.log("world/ground", _mesh(ground, albedo_factor=[*GREY, 255]), strict=True)
    # The cars of other frames are not shown.
    stream.log("world/cars", rr.Clear(recursive=True), strict=True)
    for index, row in enumerate(frame.refined):
        # All frames of a track use one name.
        track = frame.result.shapes.tracks[row]
        surface, paint = frame.painted.mesh(index)
        name = f"track_{track}" if track else frame.after[row].line
        stream.log(f"world/cars/{name}", _mesh(surface, vertex_colors=paint.rgb), strict=True)


def frame_numbers(frame_ids: Sequence[str]) -> dict[str, int]:
    """The numbers in the ids of frames, or 1, 2, .. if the ids are not distinct numbers.

    Examples:
        >>> frame_numbers(["000107", "007322"])
        {'000107': 107, '007322': 7322}
    """
    if all(one.isdigit() for one in frame_ids) and len({int(one) for one in frame_ids}) == len(frame_ids):
        return {one: int(one) for one in frame_ids}
    return {one: number for number, one in enumerate(frame_ids, start=1)}


def _log_conventions(stream: RecordingStream) -> None:
    """Log the left camera frame as world (x right, y down, z forward, metres), and line numbers as mask classes."""
    import rerun as rr

    stream.log("world", rr.ViewCoordinates.RDF, static=True, strict=True)
    # The viewer gives each number its own colour.
    classes: list[Any] = [(0, "no car", (0, 0, 0, 0))]
    classes += [(number, f"car {number}") for number in range(1, _MOST_LINES + 1)]
    for entity in (_LEFT, _RIGHT):
        stream.log(f"{entity}/masks", rr.AnnotationContext(classes), static=True, strict=True)


def _log_images(stream: RecordingStream, loaded: LoadedFrame) -> None:
    """Log both images with the camera, and masks whose values are line numbers of the cars, 0 for none."""
    import rerun as rr

    frame, detections = loaded.frame, loaded.detections
    height, width = frame.sizes[0].tolist()
    K_image = frame.camera.K_left[0].double().cpu().numpy().copy()
    # Pixels of Rerun have their corners at whole numbers, ours their centres.
    K_image[:2, 2] += 0.5
    camera = rr.Pinhole(image_from_camera=K_image, resolution=[width, height], camera_xyz=rr.ViewCoordinates.RDF)
    stream.log("world/cam", camera, strict=True)
    sides = ((_LEFT, frame.images_left, detections.mask_left), (_RIGHT, frame.images_right, detections.mask_right))
    for entity, images, masks in sides:
        stream.log(entity, rr.Image(rgb8(images[0])).compress(jpeg_quality=_JPEG_QUALITY), strict=True)
        numbers = np.zeros(masks.size_hw, dtype=np.uint16)
        for mask, detected in zip(masks, loaded.detected_objects, strict=True):
            numbers[(mask > MASK_THRESHOLD).cpu().numpy()] = detected.line_number
        stream.log(f"{entity}/masks", rr.SegmentationImage(numbers, opacity=_MASK_OPACITY), strict=True)


def _log_boxes(stream: RecordingStream, frame: RunFrame) -> None:
    """Log the boxes of the input, of the truth, and of the result, with grey for cars that were not refined."""
    for name, cars in (("before", frame.before or []), ("after", frame.after)):
        corners, colours = [car.corners_cam for car in cars], [car.colour for car in cars]
        labels = [f"{car.line} {car.status or ''}".rstrip() for car in cars]
        stream.log(f"world/boxes/{name}", _boxes(corners, colours, labels), strict=True)
    truth = frame.truth_corners_cam
    stream.log("world/boxes/truth", _boxes(truth, [GREEN] * len(truth), ["truth"] * len(truth)), strict=True)


def _boxes(corners_cam: Sequence[Array], colours: Sequence[Colour], labels: Sequence[str]) -> Any:
    """Boxes from their corners (8, 3) in the order of `box_corners`, with length, height, width along their axes."""
    import rerun as rr
    from scipy.spatial.transform import Rotation

    corners = np.array(corners_cam, dtype=np.float64).reshape(-1, 8, 3)
    axes = corners[:, :1] - corners[:, [3, 4, 1]]
    sizes = np.linalg.norm(axes, axis=2)
    # Axes are rows here, so the matrix is that of the inverse rotation.
    inverse = Rotation.from_matrix(axes / sizes[:, :, None]) if len(axes) else None
    return rr.Boxes3D(
        centers=corners.mean(axis=1),
        half_sizes=0.5 * sizes,
        quaternions=[] if inverse is None else [rr.Quaternion(xyzw=q) for q in inverse.inv().as_quat()],
        colors=np.array(colours, dtype=np.uint8).reshape(-1, 3),
        labels=list(labels),
        show_labels=False,
        fill_mode=rr.components.FillMode.MajorWireframe,
    )


def _mesh(mesh: trimesh.Trimesh, **colours: Any) -> Any:
    import rerun as rr

    return rr.Mesh3D(
        vertex_positions=np.asarray(mesh.vertices, dtype=np.float32),
        triangle_indices=np.asarray(mesh.faces, dtype=np.uint32),
        vertex_normals=np.asarray(mesh.vertex_normals, dtype=np.float32),
        **colours,
    )


def _blueprint(size_wh: tuple[int, int]) -> Any:
    """A layout with a 3D view on the left and the two images on the right."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=[0, size_wh[0]], y_range=[0, size_wh[1]])

    def image(name: str, origin: str, *contents: str) -> Any:
        return rrb.Spatial2DView(origin=origin, name=name, contents=list(contents), visual_bounds=bounds)

    left = image("left: masks and boxes", "world/cam", _LEFT, f"{_LEFT}/masks", "world/boxes/**")
    right = image("right: masks", "right", _RIGHT, f"{_RIGHT}/masks")
    # The eye is above and behind the camera and looks along the street.
    eye = rrb.EyeControls3D(position=[-7.0, -8.0, -9.0], look_target=[1.0, 1.0, 14.0], eye_up=[0.0, -1.0, 0.0])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin="world", name="3D", eye_controls=eye), rrb.Vertical(left, right)),
        rrb.TimePanel(timeline=_TIMELINE, fps=_FRAMES_PER_SECOND, play_state="paused"),
        collapse_panels=True,
    )
