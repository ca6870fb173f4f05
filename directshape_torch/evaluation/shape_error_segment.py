"""True points of cars from a disparity map inside their masks, as KITTI Stereo 2015 gives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.shape_error import Points, ShapeError, shape_error
from directshape_torch.evaluation.shape_error_estimate import EstimatedCar
from directshape_torch.geometry.camera import points_from_disparity
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.image_files import read_single_channel
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.mask_matching import match_masks

FOLDER = "disp_occ_0"


@dataclass(frozen=True)
class SegmentTruth:
    """The true disparities inside the segment of one car.

    One ray is cast for each of these pixels, so a shape that fits perfectly gives the true points themselves.

    Attributes:
        segment: which pixels these are, for reports.
        uv_left: (N, 2) pixels of the left image.
        points_cam: (N, 3) left camera frame, metres.
        K_left: (3, 3) pixels.
    """

    segment: str
    uv_left: NDArray[np.float64]
    points_cam: Points
    K_left: Tensor

    def errors(self, car: EstimatedCar) -> dict[str, ShapeError]:
        """Errors of an estimated car, one surface: "segment"."""
        return {"segment": shape_error(self.points_cam, car.points_at_pixels(self.uv_left, self.K_left))}

    def sampling_limit(self, _: EstimatedCar) -> dict[str, ShapeError]:
        """Nothing: a perfect estimate has no error here."""
        return {}


@dataclass(frozen=True)
class SegmentSource:
    """Disparity maps of a data set and the masks that say which pixels belong to a car.

    No object map is supplied with the data this was built for; the segments are instance masks of the left image, and
    the segment of a label is the mask of largest overlap with its 2D box (at least 0.3, one to one).

    Attributes:
        folder: `training/disp_occ_0` with `NNNNNN.png`.
        masks: of the left images.
    """

    folder: Path
    masks: MaskSource

    def frame_ids(self) -> tuple[str, ...]:
        """The frames that have a disparity map."""
        return tuple(sorted(path.stem for path in self.folder.glob("*.png")))

    def truths(
        self, frame_id: str, labels: Sequence[KittiObject], camera: StereoCamera
    ) -> Mapping[int, SegmentTruth]:  # by line number of the label
        """The segments of the labels of a frame that have a mask with true disparities in it.

        Raises:
            DataFormatError: the disparity map or the masks are missing or damaged.
        """
        disparity = read_disparity(self.folder / f"{frame_id}.png")
        masks = [mask for mask in self.masks.read(frame_id, disparity.shape) if mask.side == "left"]
        boxes = np.array([label.box_2d for label in labels], dtype=np.float64).reshape(-1, 4)
        found: dict[int, SegmentTruth] = {}
        for label, index in zip(labels, match_masks(boxes, masks).mask_of_detection, strict=True):
            if index >= 0:
                inside = np.asarray(masks[index].probability) > 0.5
                truth = segment_truth(f"left mask {masks[index].instance_id}", disparity, inside, camera)
                if len(truth.points_cam):
                    found[label.line_number] = truth
        return found


def read_disparity(path: Path) -> NDArray[np.float64]:
    """A disparity map (H, W), pixels, 0 where unknown, from a 16-bit PNG of disparity times 256.

    Raises:
        DataFormatError: it is missing, damaged or has not 16 bits.
    """
    stored = read_single_channel(path)
    if stored.dtype != np.uint16:
        raise DataFormatError(path, f"expected 16 bits (disparity times 256), got {stored.dtype}")
    return stored.astype(np.float64) / 256


def segment_truth(
    name: str,
    disparity: NDArray[np.float64],  # (H, W)
    inside: NDArray[np.bool_],  # (H, W)
    camera: StereoCamera,  # of one frame
) -> SegmentTruth:
    """The true points of the pixels of a segment whose disparity is known.

    The residual disparity field of a rig plays no part: it corrects what a stereo pair measures, and this is not
    measured by it.
    """
    v, u = np.nonzero(inside & (disparity > 0))
    uv = torch.from_numpy(np.stack([u, v], axis=-1).astype(np.float64))
    K_left, K_right, T_right_cam = (x[0].double() for x in (camera.K_left, camera.K_right, camera.T_right_cam))
    known = torch.from_numpy(disparity[v, u])
    points = points_from_disparity(uv, known, K_left, K_right, T_right_cam)
    valid = points.isfinite().all(dim=-1)
    return SegmentTruth(name, uv[valid].numpy(), points[valid].numpy(), K_left)
