"""Whether cars head where they are said to: the mean car's outline against the masks, also with other headings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.scene_check.car_evidence import Floats, FrameEvidence
from directshape_torch.scene_check.conventions import projected_boxes
from directshape_torch.scene_check.finding import Finding, found, of_cars
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh

# Outlines are compared at this size, box on box, so that where the car stands does not count.
_SIZE_PX = 64
_MIN_HEIGHT_PX = 25
_NEAREST_M = 3.0
# Of the mask's box and that of the 3D box: less is cut off, hidden, or wrong in other ways.
_MIN_OVERLAP = 0.4
# |cos| of the angle between the car's axis and the line of sight's normal: from ahead and behind cars look alike.
_MIN_SIDE_VIEW = 0.35
_FEWEST_CARS = 3
# Gain in agreement, and its standard errors, that make another heading the true one.
_LEAST_GAIN, _SURE = 0.035, 2.5
# What the best of eight headings gains for each car by itself, where headings say nothing; 0.03 where they are right.
_LEAST_FREE_GAIN, _FEWEST_FREE = 0.12, 8
_HEADINGS = np.arange(8) * np.pi / 4
_WAYS: dict[str, tuple[Callable[[float], float], str]] = {
    "turned by 180 degrees": (lambda yaw: yaw + np.pi, "add pi to the headings"),
    "with the opposite sign": (lambda yaw: -yaw, "negate the headings"),
}


def check_heading(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether the outlines of cars fit better with other headings."""
    gains = np.array([gain for frame in frames for gain in _gains(frame)]).reshape(-1, len(_WAYS) + 2)
    ways = {}
    of_side = gains[gains[:, -1] > _MIN_SIDE_VIEW]
    if len(of_side) >= _FEWEST_CARS:
        mean, error = of_side.mean(axis=0), of_side.std(axis=0, ddof=1) / len(of_side) ** 0.5
        sure = (mean > _LEAST_GAIN) & (mean > _SURE * error)
        ways = {way: mean[k] for k, way in enumerate(_WAYS) if sure[k]}
    if ways:
        way = max(ways, key=lambda each: ways[each])
        return [_finding(len(of_side), f"fit the masks better {way}, by {ways[way]:.2f}", _WAYS[way][1])]
    free = float(gains[:, -2].mean()) if len(gains) >= _FEWEST_FREE else 0.0
    if free < _LEAST_FREE_GAIN:
        return []
    measured = (
        f"fit the masks better with other headings, by {free:.2f}, and no rule says which: degrees look like this"
    )
    return [_finding(len(gains), measured, "turn degrees into radians (torch.deg2rad), or check the order of headings")]


def _finding(num_cars: int, measured: str, cure: str) -> Finding:
    expected = "rotation_y in radians, 0 where the car drives along +x, -pi/2 where it drives along +z"
    where = of_cars(num_cars)
    return found("box_yaw", where, f"outlines of cars {measured}", expected=expected, cure=cure)


def _gains(frame: FrameEvidence) -> list[list[float]]:
    """For each car what each way gains in agreement, what the best heading gains, and how much of its side is seen."""
    projected = projected_boxes(frame)
    height, width = frame.size_hw
    gains = []
    for car, mask in enumerate(frame.masks):
        around = frame.mask_boxes["left"][car]
        x, _, z = frame.boxes.location[car]
        yaw = float(frame.boxes.rotation_y[car])
        if mask is None or around[3] - around[1] < _MIN_HEIGHT_PX or z < _NEAREST_M:
            continue
        inside = around[0] > 1 and around[2] < width - 2 and around[3] < height - 2
        if not inside or box_iou(projected[car][None], around[None])[0, 0] < _MIN_OVERLAP:
            continue
        seen = _resized(mask, around)
        aspect = (around[2] - around[0] + 1) / (around[3] - around[1] + 1)
        as_given = _agreement(frame, car, yaw, seen, aspect)
        ways = [_agreement(frame, car, way(yaw), seen, aspect) - as_given for way, _ in _WAYS.values()]
        best = max(_agreement(frame, car, yaw + turn, seen, aspect) for turn in _HEADINGS)
        gains.append([*ways, best - as_given, abs(np.cos(yaw - np.arctan2(x, z)))])
    return gains


def _agreement(frame: FrameEvidence, car: int, yaw: float, seen: NDArray[np.bool_], aspect: float) -> float:
    """Overlap of the outline with the mask, box on box, times the ratio of their aspects."""
    outline, own_aspect = _outline(frame, car, yaw)
    overlap = float((seen & outline).sum() / (seen | outline).sum())
    return overlap * min(own_aspect / aspect, aspect / own_aspect)


@cache
def _mean_car() -> tuple[Floats, NDArray[np.int64]]:
    """Vertices, one unit long, high and wide with the origin under their middle, and triangles."""
    prior = PCAShapePrior.load_bundled()
    coarse = prior.values(prior.initial_code(1))[0, ::2, ::2, ::2]
    mesh = sdf_to_mesh(coarse, prior.origin, 2 * prior.spacing_m)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    bottom = np.array([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2])
    return (vertices - bottom) / (high - low), np.asarray(mesh.faces)


def _outline(frame: FrameEvidence, car: int, yaw: float) -> tuple[NDArray[np.bool_], float]:
    """The mean car in the box of a car, drawn box-filling, and width over height of its image."""
    import cv2

    vertices, faces = _mean_car()
    height, width, length = frame.boxes.hwl[car]
    points = vertices * [length, height, width]
    location = torch.from_numpy(frame.boxes.location[car]) + frame.camera.t_cam_ref[0]
    T = pose_from_kitti(location, torch.tensor(yaw, dtype=torch.float64)).numpy()
    image = (points @ T[:3, :3].T + T[:3, 3]) @ frame.camera.K_left[0].numpy().T
    uv = image[:, :2] / np.maximum(image[:, 2:], 1e-3)
    low, high = uv.min(axis=0), uv.max(axis=0)
    corners = np.round((uv - low) / (high - low) * (_SIZE_PX - 1) * 16).astype(np.int32)[faces]
    drawn = np.zeros((_SIZE_PX, _SIZE_PX), np.uint8)
    for triangle in corners:
        cv2.fillConvexPoly(drawn, triangle, 1, shift=4)
    return drawn > 0, float((high - low)[0] / (high - low)[1])


def _resized(mask: NDArray[np.bool_], around: Floats) -> NDArray[np.bool_]:
    import cv2

    u0, v0, u1, v1 = around.astype(int)
    part = mask[v0 : v1 + 1, u0 : u1 + 1].astype(np.float32)
    return np.asarray(cv2.resize(part, (_SIZE_PX, _SIZE_PX), interpolation=cv2.INTER_AREA) > 0.5)
