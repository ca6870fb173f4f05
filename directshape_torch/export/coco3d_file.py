"""Boxes of a run as one JSON file in the manner of COCO with Omni3D's 3D fields."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.run_folder import FrameResult, ResultObject
from directshape_torch.io.stereo_dataset import LoadedFrame

# Omni3D's order of the eight corners, in units of half (length, height, width) along x, y (down), z of the object.
_CORNERS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64
)
_UNKNOWN = -1

KITTI_TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
"""Category ids are places in this list, from 1; types that a detector adds come after them."""


class Coco3dDataset:
    """Collects frames; `content` is the dictionary of the JSON file."""

    def __init__(self) -> None:
        self.category_ids = {name: number for number, name in enumerate(KITTI_TYPES, start=1)}
        self.images: list[dict[str, Any]] = []
        self.annotations: list[dict[str, Any]] = []

    def add(self, frame: FrameResult, loaded: LoadedFrame, image_id: int, file_path: str) -> None:
        """Add a frame.

        Args:
            frame: its boxes.
            loaded: its calibration and the size of its left image.
            image_id: a number of its own.
            file_path: of the left image, as the file shall name it.
        """
        height, width = loaded.frame.sizes[0].tolist()
        K_left = loaded.frame.camera.K_left[0].double().numpy()
        t_cam_ref = loaded.frame.camera.t_cam_ref[0].double().numpy()
        self.images.append(
            {
                "id": image_id,
                "dataset_id": 0,
                "width": width,
                "height": height,
                "file_path": file_path,
                "K": K_left.tolist(),
                "src_90_rotate": 0,
                "src_flagged": False,
            }
        )
        for one in frame.objects:
            ids = {"id": len(self.annotations) + 1, "image_id": image_id}
            category = {"category_id": self._category_id(one.line.type), "category_name": one.line.type.lower()}
            box = _box_fields(one, one.centre_ref + t_cam_ref, K_left, (width, height))
            self.annotations.append({**ids, **category, **_detection_fields(one), **box})

    def _category_id(self, name: str) -> int:
        return self.category_ids.setdefault(name, len(self.category_ids) + 1)

    @property
    def content(self) -> dict[str, Any]:
        """What the file holds."""
        info = {
            "id": "0",
            "source": 0,
            "name": "directshape",
            "split": "refined",
            "version": "1",
            "url": "",
            "coordinates": "left colour camera: x right, y down, z forward, metres; whole numbers are pixel centres",
        }
        categories = [
            {"id": number, "name": name.lower(), "supercategory": "object"}
            for name, number in self.category_ids.items()
        ]
        return {"info": info, "images": self.images, "categories": categories, "annotations": self.annotations}


def _detection_fields(one: ResultObject) -> dict[str, Any]:
    """What plain COCO readers ask for, and what the detector and the refinement say."""
    u_min, v_min, u_max, v_max = one.line.box_2d
    return {
        "bbox": [u_min, v_min, u_max - u_min, v_max - v_min],
        "area": (u_max - u_min) * (v_max - v_min),
        "iscrowd": 0,
        "ignore": False,
        "bbox2D_tight": list(one.line.box_2d),
        "score": 1.0 if one.line.score is None else one.line.score,
        "truncation": one.line.truncated,
        "visibility": _UNKNOWN,
        "segmentation_pts": _UNKNOWN,
        "lidar_pts": _UNKNOWN,
        "depth_error": _UNKNOWN,
        "status": one.status,
        "line": one.line.line_number,
    }


def _box_fields(
    one: ResultObject, centre_cam: NDArray[np.float64], K_left: NDArray[np.float64], size_wh: tuple[int, int]
) -> dict[str, Any]:
    height, width, length = one.hwl.tolist()
    corners_cam = centre_cam + 0.5 * (_CORNERS * [length, height, width]) @ one.R_ref_obj.T
    is_behind = bool((corners_cam[:, 2] <= 0).any())
    projected, truncated = _projected_boxes(corners_cam, K_left, size_wh)
    return {
        "valid3D": True,
        "center_cam": centre_cam.tolist(),
        "dimensions": [width, height, length],
        "R_cam": one.R_ref_obj.tolist(),
        "bbox3D_cam": corners_cam.tolist(),
        "behind_camera": is_behind,
        "bbox2D_proj": [_UNKNOWN] * 4 if is_behind else projected,
        "bbox2D_trunc": [_UNKNOWN] * 4 if is_behind else truncated,
    }


def _projected_boxes(
    corners_cam: NDArray[np.float64], K_left: NDArray[np.float64], size_wh: tuple[int, int]
) -> tuple[list[float], list[float]]:
    """The 2D box of the projected corners, as it is and cut off at the borders of the image; meaningless behind."""
    depth = np.where(corners_cam[:, 2:] > 0, corners_cam[:, 2:], 1.0)
    uv = (corners_cam @ K_left.T)[:, :2] / depth
    whole = np.array([uv.min(axis=0), uv.max(axis=0)])
    cut = whole.clip(0, np.array(size_wh) - 1)
    return whole.ravel().tolist(), cut.ravel().tolist()


def image_numbers(frame_ids: Sequence[str]) -> dict[str, int]:
    """KITTI's frame numbers as image ids, or 1, 2, .. where the ids are no numbers.

    Examples:
        >>> image_numbers(["000107", "007322"])
        {'000107': 107, '007322': 7322}
    """
    if all(one.isdigit() for one in frame_ids) and len({int(one) for one in frame_ids}) == len(frame_ids):
        return {one: int(one) for one in frame_ids}
    return {one: number for number, one in enumerate(frame_ids, start=1)}
