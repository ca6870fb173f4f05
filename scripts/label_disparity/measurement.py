"""The disparity on the visible side of a labelled car, measured on the images, against that of its label."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.camera import disparity_of_depth
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.image_files import find_image, read_rgb
from directshape_torch.io.instance_masks import file_of_frame
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.rig.disparity_observations import KnownDepth, cell_index, observe_disparity
from directshape_torch.rig.labels import depth_of_near_side, known_depth_of_car
from directshape_torch.scene import StereoCamera

# Patches are 9 x 9 pixels; one in each such cell of the image is independent of the others.
_PATCH_PX = 9
# Standard deviation by the median absolute deviation, and error of a median by the standard deviation (normal data).
_SIGMA_BY_MAD, _MEDIAN_ERROR_BY_SIGMA = 1.4826, 1.2533


@dataclass(frozen=True)
class Frame:
    """Images, camera and objects of one frame; objects by line number."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    camera: StereoCamera
    labels: dict[int, KittiObject]
    refined: dict[int, KittiObject]


@dataclass(frozen=True)
class SideMeasurement:
    """What the images say of a labelled car's visible side.

    Attributes:
        uv: (2,) median pixel.
        depth_m: of the label's side there, median.
        image_px: disparity on the image minus the label's, freed of the field, median over patches.
        sigma_px: standard error of that median.
        side_px: disparity of the refined box's side minus the label's, median over the same patches; NaN if it has
            none there.
        num_patches: of them.
    """

    uv: Tensor
    depth_m: float
    image_px: float
    sigma_px: float
    side_px: float
    num_patches: int


def read_frame(root: Path, after: Path, frame_id: str, field: DisparityField | None) -> Frame:
    """Everything of one frame; refuses one of another rig than the field's."""
    training = root / "training"
    camera = to_stereo_camera([read_calibration(training / "calib" / f"{frame_id}.txt")], dtype=torch.float64)
    left, right = (read_rgb(find_image(training / name, frame_id)) for name in ("image_2", "image_3"))
    if field is not None:
        field.check_rig((left.shape[1], left.shape[0]), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])
    labels = read_objects(training / "label_2" / f"{frame_id}.txt")
    refined = read_objects(file_of_frame(after, f"{frame_id}.txt"))
    return Frame(left, right, camera, {o.line_number: o for o in labels}, {o.line_number: o for o in refined})


def disparity(camera: StereoCamera, uv: Tensor, depth: Tensor) -> Tensor:
    """Ideal disparity (P,) of left pixels (P, 2) at depths (P,), without any residual field."""
    return disparity_of_depth(uv, depth, camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])[:, 0]


def measure_side(
    frame: Frame, label: KittiObject, refined: KittiObject, field: DisparityField | None
) -> SideMeasurement | None:
    """Measure the visible side of a labelled car, None without a patch; what nearer labels may hide is left out."""
    size_wh = (frame.left.shape[1], frame.left.shape[0])
    known = known_depth_of_car(label, size_wh, frame.camera)
    seen = ~_hidden(known.uv_left, label, list(frame.labels.values()))
    visible = KnownDepth(known.uv_left[seen], known.depth_m[seen])
    observed = observe_disparity(frame.left, frame.right, frame.camera, visible)
    if not len(observed):
        return None
    uv, true_depth = observed.uv_left, observed.depth_m
    image = (observed.bias_px if field is None else observed.bias_px - field.bias(uv)).numpy()
    side = disparity(frame.camera, uv, depth_of_near_side(refined, uv, frame.camera))
    side = (side - disparity(frame.camera, uv, true_depth))[side.isfinite()]
    grid = (-(-size_wh[0] // _PATCH_PX), -(-size_wh[1] // _PATCH_PX))
    num_independent = len(np.unique(cell_index(uv, size_wh, grid).numpy()))
    return SideMeasurement(
        uv=uv.median(dim=0).values,
        depth_m=float(true_depth.median()),
        image_px=float(np.median(image)),
        sigma_px=_MEDIAN_ERROR_BY_SIGMA * _SIGMA_BY_MAD * spread(image) / num_independent**0.5,
        side_px=float(np.median(side.numpy())) if len(side) else np.nan,
        num_patches=len(observed),
    )


def _hidden(uv: Tensor, label: KittiObject, labels: Sequence[KittiObject]) -> Tensor:
    hidden = torch.zeros(len(uv), dtype=torch.bool)
    for other in labels:
        if other.has_box_3d and other.location_ref[2] < label.location_ref[2]:
            u_min, v_min, u_max, v_max = other.box_2d
            hidden |= (uv >= torch.tensor([u_min, v_min])).all(1) & (uv <= torch.tensor([u_max, v_max])).all(1)
    return hidden


def spread(values: NDArray[np.float64]) -> float:
    """Median absolute deviation from the median."""
    return float(np.median(np.abs(values - np.median(values)))) if len(values) else np.nan
