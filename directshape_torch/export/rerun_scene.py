"""One frame in a Rerun recording: images, masks, boxes before and after, surfaces, ground."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.export.frame_source import FrameSource
from directshape_torch.export.painted_cars import PaintedFrame
from directshape_torch.export.rerun_stream import RerunStream
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.visualize.drawing import BLUE, GREEN, GREY, ORANGE, picture_of
from directshape_torch.visualize.ground_grid import ground_grid

LEFT, RIGHT = "world/cam/image", "right/image"
_JPEG_QUALITY = 90
_MASK_OPACITY = 0.35
_MOST_LINES = 255


def log_conventions(stream: RerunStream) -> None:
    """The world is the left camera frame: x right, y down, z forward, metres. Masks have the numbers of lines."""
    stream.log("world", stream.rr.ViewCoordinates.RDF, static=True)
    context = stream.rr.AnnotationContext([(0, "no car", (0, 0, 0, 0)), *_car_classes()])
    for entity in (LEFT, RIGHT):
        stream.log(f"{entity}/masks", context, static=True)


def log_frame(stream: RerunStream, source: FrameSource, has_detections: bool) -> None:
    """Everything of a frame but its iterations, at the present places of the timelines.

    Args:
        stream: the recording.
        source: the frame, with images.
        has_detections: whether its data set has the detections of the run, so that boxes before are known.
    """
    loaded = source.with_images("the pictures of a recording")
    _log_images(stream, loaded)
    _log_masks(stream, loaded)
    offset = loaded.frame.camera.t_cam_ref[0].double()
    stream.log(
        "world/boxes/before", boxes_of_lines(stream, loaded.detected_objects if has_detections else [], offset, ORANGE)
    )
    labels = [one for one in loaded.labels or [] if one.has_box_3d and one.type in set(source.run.classes)]
    stream.log("world/boxes/truth", boxes_of_lines(stream, labels, offset, GREEN))
    _log_refined_boxes(stream, source, offset.numpy())
    ground = ground_grid(loaded.frame.ground.normal[0], float(loaded.frame.ground.offset[0]))
    stream.log("world/ground", mesh(stream, ground.vertices, ground.faces, colour=GREY))


def clear_cars(stream: RerunStream) -> None:
    """Take away what the cars of other frames left at the present places."""
    residuals = [f"{LEFT}/silhouette", f"{RIGHT}/silhouette", f"{LEFT}/photometric"]
    for entity in ("world/cars", "world/boxes/iteration", *residuals):
        stream.log(entity, stream.rr.Clear(recursive=True))


def log_painted_cars(stream: RerunStream, painted: PaintedFrame) -> None:
    """The refined surfaces with the image's colours, under one name through all frames of a track."""
    for index, one in enumerate(painted.objects):
        surface, paint = painted.mesh(index)
        normals = surface.vertex_normals
        content = mesh(stream, surface.vertices, surface.faces, normals=normals, colours=paint.rgb)
        track = painted.frame.shapes.tracks[one.car]
        stream.log(f"world/cars/track_{track}" if track else f"world/cars/{one.line.line_number}", content)


def mesh(
    stream: RerunStream,
    vertices_cam: NDArray[Any],
    faces: NDArray[Any],
    normals: NDArray[Any] | None = None,
    colours: NDArray[np.uint8] | None = None,
    colour: tuple[int, int, int] | None = None,
) -> Any:
    """Triangles with a colour for each vertex, or one for all."""
    return stream.rr.Mesh3D(
        vertex_positions=np.asarray(vertices_cam, dtype=np.float32),
        triangle_indices=np.asarray(faces, dtype=np.uint32),
        vertex_normals=None if normals is None else np.asarray(normals, dtype=np.float32),
        vertex_colors=colours,
        albedo_factor=None if colour is None else [*colour, 255],
    )


def boxes(
    stream: RerunStream,
    centres_cam: NDArray[np.float64],  # (B, 3)
    R_cam_obj: NDArray[np.float64],  # (B, 3, 3)
    hwl: NDArray[np.float64],  # (B, 3)
    colours: Sequence[tuple[int, int, int]],
    labels: Sequence[str],
) -> Any:
    """Boxes with length, height, width along the axes of their objects."""
    from scipy.spatial.transform import Rotation

    rr = stream.rr
    quaternions = Rotation.from_matrix(R_cam_obj.reshape(-1, 3, 3)).as_quat() if len(hwl) else np.zeros((0, 4))
    return rr.Boxes3D(
        centers=centres_cam.reshape(-1, 3),
        half_sizes=0.5 * hwl.reshape(-1, 3)[:, [2, 0, 1]],
        quaternions=[rr.Quaternion(xyzw=q) for q in quaternions],
        colors=np.array(colours, dtype=np.uint8).reshape(-1, 3),
        labels=list(labels),
        show_labels=False,
        fill_mode=rr.components.FillMode.MajorWireframe,
    )


def boxes_of_lines(
    stream: RerunStream, lines: Sequence[KittiObject], t_cam_ref: Tensor, colour: tuple[int, int, int]
) -> Any:
    """The boxes of lines of a KITTI file, labelled with their numbers."""
    T_cam_obj = poses_cam(lines, t_cam_ref).numpy()
    hwl = np.array([one.hwl for one in lines], dtype=np.float64).reshape(-1, 3)
    centres_cam = T_cam_obj[:, :3, 3] - 0.5 * hwl[:, :1] * T_cam_obj[:, :3, 1]
    labels = [f"{one.line_number}" for one in lines]
    return boxes(stream, centres_cam, T_cam_obj[:, :3, :3], hwl, [colour] * len(lines), labels)


def _car_classes() -> list[tuple[int, str, tuple[int, int, int, int]]]:
    """Numbers, names and colours of cars; hues a golden angle apart differ as much as they can."""
    classes = []
    for number in range(1, _MOST_LINES + 1):
        red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb((number * 0.618) % 1, 0.8, 1.0))
        classes.append((number, f"car {number}", (red, green, blue, 255)))
    return classes


def _log_refined_boxes(stream: RerunStream, source: FrameSource, t_cam_ref: NDArray[np.float64]) -> None:
    """The boxes of the result; those that were not refined are grey."""
    cars = [one for one in source.refined.objects if one.car >= 0]
    centres = np.array([one.centre_ref + t_cam_ref for one in cars])
    R_cam_obj, hwl = (np.array([getattr(one, name) for one in cars]) for name in ("R_ref_obj", "hwl"))
    colours = [BLUE if one.is_refined else GREY for one in cars]
    labels = [f"{one.line.line_number} {one.status}" for one in cars]
    stream.log("world/boxes/after", boxes(stream, centres, R_cam_obj, hwl, colours, labels))


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
