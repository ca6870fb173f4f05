"""This module checks whether LiDAR points fit the images, and if not, which other way to read them fits.

Its hypotheses are other columns, axes, units and places of the scanner, and the score is the share of the points that
have the disparity of the images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from directshape_torch.check.car_evidence import T_CAMERA_LIDAR, Floats, FrameEvidence, Pair, Scan
from directshape_torch.check.conventions import AS_DOCUMENTED, Axes
from directshape_torch.check.finding import Finding, Severity
from directshape_torch.check.hypotheses import accepted
from directshape_torch.check.mistakes import found
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.stereo_matching.disparity import match_disparity

# This is the share of the points above the road with the disparity of the images. Correct scans reach 0.73 or more,
# scans of other frames, axes and columns at most 0.44.
AGREEMENT_ERROR, AGREEMENT_WARNING = 0.5, 0.6
# Another way to read a scan must gain this.
_MIN_GAIN = 0.2
# Ways whose numbers of agreeing points differ by less than this share count as equal.
_TIE = 0.05
# The tolerance, in pixels and as a share, covers the errors of the rig's disparity and of the matching.
_TOLERANCE_PX, _TOLERANCE_SHARE = 2.0, 0.05
# Roads look alike in all frames, so points this far below the camera say little.
_ROAD_BELOW_M = 1.2
_NEAREST_M = 1.0
_FEWEST_POINTS = 100
_MOST_POINTS = 5000
_COLUMNS = (4, 5, 6, 3)  # as documented first
_AXES = {  # axes of the file that become x forward, y left, z up
    AS_DOCUMENTED: Axes(),
    "x and y exchanged": Axes((2, 1, 3)),
    "x right, y forward, z up (nuScenes)": Axes((2, -1, 3)),
    "x right, y down, z forward (a camera's)": Axes((3, -1, -2)),
    "x forward, y left, z up where a camera's axes are expected": Axes((-2, -3, 1)),
    "y to the right": Axes((1, -2, 3)),
    "y to the right, z down": Axes((1, -2, -3)),
    "x backward, y to the right": Axes((-1, -2, 3)),
    "y and z exchanged": Axes((1, 3, 2)),
}
_UNITS = {AS_DOCUMENTED: 1.0, "millimetres": 0.001, "centimetres": 0.01}
_PLACES: dict[str, Callable[[Floats], Floats]] = {
    AS_DOCUMENTED: lambda T: T,
    "inverted": lambda T: np.asarray(np.linalg.inv(T)),
    "of a LiDAR beside the camera, not this one": lambda _: T_CAMERA_LIDAR,
}


class _Way(NamedTuple):
    """A `_Way` is one way to read a scan."""

    columns: int = _COLUMNS[0]
    axes: str = AS_DOCUMENTED
    unit: str = AS_DOCUMENTED
    place: str = AS_DOCUMENTED

    def is_possible(self, scan: Scan) -> bool:
        """Whether the file could have such columns; points of tensors have no calibration that could be wrong."""
        is_tensor = scan.T_cam_lidar is T_CAMERA_LIDAR
        return self.columns in scan.points and (self.place == AS_DOCUMENTED or not is_tensor)

    @property
    def words(self) -> list[str]:
        """The deviations from the documented way, as text."""
        of_columns = [] if self.columns == _COLUMNS[0] else [f"as {self.columns} numbers a point"]
        parts = {"with the axes": self.axes, "in": self.unit, "with the calibration": self.place}
        return of_columns + [f"{part} {value}" for part, value in parts.items() if value != AS_DOCUMENTED]

    def points_cam(self, scan: Scan) -> Floats:
        """The finite points (P, 3) of a scan in the left camera, read in this way."""
        points = scan.points[self.columns]
        # The choice is random, since every n-th point of wrong columns may be correct.
        points = points[np.random.default_rng(0).choice(len(points), min(len(points), _MOST_POINTS), replace=False)]
        points = points[np.isfinite(points).all(axis=1)]
        with np.errstate(over="ignore", invalid="ignore"):
            T = _PLACES[self.place](scan.T_cam_lidar)
            return np.asarray(_AXES[self.axes].points(_UNITS[self.unit] * points) @ T[:3, :3].T + T[:3, 3])


def check_lidar(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Findings from all frames that have both a scan and images."""
    judges = {
        one.frame_id: _Judge(one.scan, one.pair, one.camera)
        for one in frames
        if one.scan is not None and one.pair is not None and len(one.scan.points[_COLUMNS[0]]) >= _FEWEST_POINTS
    }
    judges = {name: judge for name, judge in judges.items() if judge.can_tell}
    shares = {name: judge.share(_Way()) for name, judge in judges.items()}
    if not shares:
        return []
    mean = float(np.mean(list(shares.values())))
    if mean >= AGREEMENT_WARNING:
        wrong = {name: share for name, share in shares.items() if share < AGREEMENT_ERROR}
        return [_finding("warning", f"frame {name}", share) for name, share in wrong.items()]
    words = _better_way(list(judges.values()), mean)
    severity: Severity = "error" if words or mean < AGREEMENT_ERROR else "warning"
    return [_finding(severity, f"all frames, {len(shares)} scans", mean, *words)]


def _finding(severity: Severity, where: str, share: float, fits: str = "", cure: str = "") -> Finding:
    measured = f"{share:.0%} of the LiDAR points above the road have the disparity of the images{fits}"
    limit = f"{AGREEMENT_WARNING:.0%}".replace("%", " %")
    return found("lidar_elsewhere", where, measured.replace("%", " %"), severity=severity, cure=cure, limit=limit)


def _better_way(judges: Sequence[_Judge], mean: float) -> tuple[str, ...]:
    """Words and cure for the way to read the scans that fits clearly better, or none; ties go to the simplest.

    The way with most agreeing points is taken, because wrong columns keep a part of the points correct, which agree as
    well.
    """
    ways = [_Way(*parts) for parts in product(_COLUMNS, _AXES, _UNITS, _PLACES)]
    ways = [way for way in ways if all(way.is_possible(judge.scan) for judge in judges)]
    counts = np.array([np.mean([judge.agree(way).sum() for judge in judges]) for way in ways])
    best = accepted(counts, 0.0, deviations=[len(way.words) for way in ways], tie=_TIE * counts.max())
    if best is None:
        return ()
    share = float(np.mean([judge.share(ways[best]) for judge in judges]))
    if accepted((mean, share), _MIN_GAIN, AGREEMENT_ERROR) is None:
        return ()
    words = ", ".join(ways[best].words)
    fits = f", {share:.0%} when the scan is read {words}"
    return fits, f"give points as documented (docs/inputs.md): they fit when read {words}"


class _Judge:
    """A `_Judge` compares the scan of a frame with its images."""

    def __init__(self, scan: Scan, pair: Pair, camera: StereoCamera) -> None:
        self.scan = scan
        self.K_left, self.K_right = camera.K_left[0].numpy(), camera.K_right[0].numpy()
        self.T_right_cam = camera.T_right_cam[0].numpy()
        self.disparity = match_disparity(*pair)
        self.can_tell = int(np.isfinite(self.disparity).sum()) >= _MOST_POINTS
        # With wrong columns some points are correct, and most of the others are outside the image.
        self._fewest = max(_FEWEST_POINTS, *(self.agree(_Way(columns)).sum() for columns in scan.points))

    def share(self, way: _Way) -> float:
        """Share of the points above the road, with known disparity in the image, that agree with it."""
        agree = self.agree(way)
        return float(agree.sum() / max(len(agree), self._fewest))

    def agree(self, way: _Way) -> Floats:
        """1 for each of these points that agrees, 0 for the others."""
        points_cam = way.points_cam(self.scan)
        high = self._compared(points_cam[points_cam[:, 1] < _ROAD_BELOW_M])
        return high if len(high) >= _FEWEST_POINTS else self._compared(points_cam)

    def _compared(self, points_cam: Floats) -> Floats:
        height, width = self.disparity.shape
        points_cam = points_cam[points_cam[:, 2] > _NEAREST_M]
        left = points_cam @ self.K_left.T
        right = (points_cam @ self.T_right_cam[:3, :3].T + self.T_right_cam[:3, 3]) @ self.K_right.T
        uv = left[:, :2] / left[:, 2:]
        inside = ((uv > -0.5) & (uv < [width - 0.5, height - 0.5])).all(axis=1)
        u, v = uv[inside].round().astype(int).T
        expected = (uv[:, 0] - right[:, 0] / right[:, 2])[inside]
        measured = self.disparity[v, u]
        known = np.isfinite(measured)
        limit = np.maximum(_TOLERANCE_PX, _TOLERANCE_SHARE * measured[known])
        return np.asarray(np.abs(expected[known] - measured[known]) < limit, dtype=np.float64)
