"""What a moving stereo rig sees of still things: their disparity, and where they are in a later left image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.camera import depth_from_disparity, project, rays_from_pixels
from directshape_torch.geometry.se3 import from_rotation_translation, transform
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.image.grey_levels import grey_levels
from directshape_torch.stereo_matching.disparity import match_disparity
from directshape_torch.stereo_matching.patch_alignment import PatchLimits, align_patches
from directshape_torch.stereo_matching.subpixel import refine_disparity

# Later frames to which points are followed. One step shows the near points best, several the far ones.
STEPS = (1, 2, 4)
_GRID = (16, 8)
_CORNERS_PER_CELL = 25
_CORNER_QUALITY = 0.02
_CORNER_DISTANCE_PX = 5
_BORDER_PX = 12
_WINDOW_PX = 11
_LARGEST_RETURN_ERROR_PX = 0.5
_RANSAC_TOLERANCE_PX = 2.0
_FEWEST_TRACKS = 50
# A window that moves but does not grow errs by half a pixel on things that come nearer by a fifth: patches are aligned
# with the zoom known, and held against weak texture in either direction.
_LIMITS = PatchLimits(radius_px=5, change_px=1.5, sigma_px=(0.06, 0.06))
# A car that stands shows no depth by its motion.
_SMALLEST_MOTION_M = 0.3


@dataclass(frozen=True)
class StereoFeatures:
    """Corners of one left image with their disparity.

    Attributes:
        grey_left: (H, W) the left image.
        uv_left: (P, 2) pixels, float64.
        disparity: (P,) measured, pixels.
        row_shift: (P,) measured v_left - v_right, pixels.
        points_cam: (P, 3) metres, as the raw disparity has them.
    """

    grey_left: NDArray[np.uint8]
    uv_left: Tensor
    disparity: Tensor
    row_shift: Tensor
    points_cam: Tensor


@dataclass(frozen=True)
class TrackedFeatures:
    """Corners of one left image that were found again in a later one.

    Attributes:
        uv_left: (P, 2) pixels, float64.
        disparity, row_shift: (P,) pixels.
        uv_later: (P, 2) pixels in the later left image.
        T_later_cam: (4, 4) motion of the left camera, roughly.
    """

    uv_left: Tensor
    disparity: Tensor
    row_shift: Tensor
    uv_later: Tensor
    T_later_cam: Tensor


def matched_pixels(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
    uv_left: Tensor,  # (P, 2) whole pixels, float64
    matched: Tensor,  # (H, W) start, pixels
) -> tuple[Tensor, Tensor, Tensor]:
    """Those of the pixels whose patches could be aligned: (Q, 2), their disparity (Q,) and row shift (Q,)."""
    left, right = (
        grey_levels((torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).double() / 255)[None])[0]
        for image in (image_left, image_right)
    )
    start = matched[uv_left[:, 1].long(), uv_left[:, 0].long()]
    disparity, row_shift, reliable = refine_disparity(left, right, uv_left, start, torch.zeros_like(start))
    return uv_left[reliable], disparity[reliable], row_shift[reliable]


def find_features(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
    camera: StereoCamera,  # one frame
    matched: Tensor | None = None,  # (H, W) semi-global disparity, where it is known already
) -> StereoFeatures:
    """Corners spread evenly over the left image, with disparities from patches whose rows are free."""
    import cv2

    grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(image_left), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if matched is None:
        matched = torch.from_numpy(match_disparity(image_left, image_right)).double()
    uv = _corners(grey, matched.isfinite().numpy())
    uv, disparity, row_shift = matched_pixels(image_left, image_right, uv, matched)
    K_left, K_right, T_right_cam = (t[0].double() for t in (camera.K_left, camera.K_right, camera.T_right_cam))
    depth = depth_from_disparity(uv, disparity, K_left, K_right, T_right_cam)
    in_front = depth.isfinite()
    points_cam = depth[:, None] * rays_from_pixels(uv, K_left)
    return StereoFeatures(grey, uv[in_front], disparity[in_front], row_shift[in_front], points_cam[in_front])


def _corners(grey: NDArray[np.uint8], usable: NDArray[np.bool_]) -> Tensor:
    """(P, 2) whole pixels: the strongest corners of each image cell."""
    import cv2

    height, width = grey.shape
    inside = np.zeros((height, width), np.uint8)
    inside[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = 255
    inside[~usable] = 0
    found = []
    for row in range(_GRID[1]):
        for column in range(_GRID[0]):
            cell = np.zeros_like(inside)
            rows = slice(row * height // _GRID[1], (row + 1) * height // _GRID[1])
            columns = slice(column * width // _GRID[0], (column + 1) * width // _GRID[0])
            cell[rows, columns] = inside[rows, columns]
            corners = cv2.goodFeaturesToTrack(grey, _CORNERS_PER_CELL, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=cell)
            if corners is not None:
                found.append(np.asarray(corners)[:, 0])
    return torch.from_numpy(np.concatenate([np.zeros((0, 2), np.float32), *found])).double()


def track_features(
    features: StereoFeatures,
    later: list[NDArray[np.uint8]],  # the left images (H, W) of the frames that follow, in order
    camera: StereoCamera,  # one frame
) -> list[TrackedFeatures]:
    """Follow corners into the later images that are `STEPS` away; steps that fail are left out.

    Each later image is compared with the first one, not with the one before it, so errors do not add up. Where to look
    is foretold from the motion so far.
    """
    tracked = []
    foretold: NDArray[np.float32] | None = None
    for step, grey_later in enumerate(later[: max(STEPS)], start=1):
        uv_later, found = _follow(features.grey_left, grey_later, features.uv_left, foretold)
        motion = _rough_motion(features.points_cam[found], uv_later[found], camera)
        if motion is None:
            break
        if step in STEPS and float(np.linalg.norm(motion[1])) >= _SMALLEST_MOTION_M:
            tracked.append(_tracked(features, grey_later, uv_later, found, motion))
        foretold = _foretell(features.points_cam, motion, (step + 1) / step, camera)
    return tracked


def _tracked(
    features: StereoFeatures,
    grey_later: NDArray[np.uint8],
    uv_later: Tensor,
    found: Tensor,
    motion: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> TrackedFeatures:
    """The points that were found, aligned anew with the size that they have in the later image."""
    T_later_cam = from_rotation_translation(torch.from_numpy(_rotation(motion[0])), torch.from_numpy(motion[1]))
    depth_later = transform(T_later_cam, features.points_cam)[:, 2]
    zoom = (features.points_cam[:, 2] / depth_later.clamp_min(0.5))[found]
    first, later = (torch.from_numpy(image).double() for image in (features.grey_left, grey_later))
    uv_left, uv_start = features.uv_left[found], uv_later[found]
    aligned, reliable = align_patches(first, later, uv_left, uv_start, _LIMITS, zoom)
    uv_left, disparity, row_shift = (
        t[found][reliable] for t in (features.uv_left, features.disparity, features.row_shift)
    )
    return TrackedFeatures(uv_left, disparity, row_shift, aligned[reliable], T_later_cam)


def _follow(
    grey: NDArray[np.uint8], grey_later: NDArray[np.uint8], uv: Tensor, foretold: NDArray[np.float32] | None
) -> tuple[Tensor, Tensor]:
    """Pyramidal Lucas-Kanade there and back: pixels in the later image and whether the way back ends at the start."""
    import cv2

    if len(uv) == 0:
        return uv, torch.zeros(0, dtype=torch.bool)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.005)
    window = (_WINDOW_PX, _WINDOW_PX)
    start = uv.numpy().astype(np.float32)
    guess, levels = (start, 3) if foretold is None else (foretold, 1)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        grey, grey_later, start, guess.copy(), winSize=window, maxLevel=levels, criteria=criteria, flags=flags
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        grey_later, grey, there, start.copy(), winSize=window, maxLevel=1, criteria=criteria, flags=flags
    )
    close = np.linalg.norm(back - start, axis=-1) < _LARGEST_RETURN_ERROR_PX
    keep = (found[:, 0] > 0) & (returned[:, 0] > 0) & close
    return torch.from_numpy(np.asarray(there, dtype=np.float64)), torch.from_numpy(keep)


def _rough_motion(
    points_cam: Tensor,  # (P, 3)
    uv_later: Tensor,  # (P, 2)
    camera: StereoCamera,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Rotation vector (3,) and translation (3,) that most of the points agree with."""
    import cv2

    if len(points_cam) < _FEWEST_TRACKS:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points_cam.numpy(),
        uv_later.numpy(),
        camera.K_left[0].double().numpy(),
        None,
        reprojectionError=_RANSAC_TOLERANCE_PX,
        iterationsCount=300,
        confidence=0.999,
    )
    if not found or inliers is None or len(inliers) < _FEWEST_TRACKS:
        return None
    return np.asarray(rotation, dtype=np.float64)[:, 0], np.asarray(translation, dtype=np.float64)[:, 0]


def _rotation(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    import cv2

    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)


def _foretell(
    points_cam: Tensor, motion: tuple[NDArray[np.float64], NDArray[np.float64]], factor: float, camera: StereoCamera
) -> NDArray[np.float32]:
    """Pixels (P, 2) of the points after `factor` times the motion; far outside of the image where they pass it."""
    rotation, translation = (torch.from_numpy(part) for part in (_rotation(motion[0] * factor), motion[1] * factor))
    later = points_cam @ rotation.T + translation
    uv = project(later, camera.K_left[0].double())
    return torch.where(later[:, 2:] > 0.5, uv, torch.full_like(uv, -1e3)).numpy().astype(np.float32)
