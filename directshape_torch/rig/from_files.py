"""This module collects evidence on rigs from files: detections, disparity maps, LiDAR or consecutive frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError, DirectShapeError, InputError
from directshape_torch.files.find_files import visible_files
from directshape_torch.geometry.projection import project
from directshape_torch.io.frame_choice import frames_among
from directshape_torch.io.frame_layout import FrameFiles
from directshape_torch.io.image_files import read_disparity, read_pair, read_rgb
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera
from directshape_torch.io.layouts import tracking_layout
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.io.velodyne import read_scan
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.motion import STEPS, StereoFeatures, find_features, track_features
from directshape_torch.rig.pixels import observe_disparity, pixel_evidence
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.rigs import rig_among
from directshape_torch.rig.self_calibration import FieldConstraint, find_road
from directshape_torch.stereo_matching.patch_alignment import MatchedPair

TruthSource = Literal["disparity", "lidar"]
Frame = tuple[Rig, Tensor]  # a rig and its observations (P, 4), see `observe_disparity`

# A frame takes half a second, and more frames hardly improve an estimate from detections.
_MOST_FRAMES = 60
_SIGMA_PX = 0.06
_DEPTH_RANGE_M = (3.0, 80.0)
# The scanner stands higher than the camera and looks over objects. A point is hidden if a neighbour within this many
# pixels is nearer by this much disparity. On a level road five rows make 1.6 px.
_WINDOW_PX = 5
_HIDDEN_BY_PX = 2.5


def estimate_rigs(
    dataset: StereoDataset,
    tell: Callable[[str], object] = lambda _: None,
    rigs: list[RigEstimate] | None = None,
) -> list[RigEstimate]:
    """Make one estimate for each calibration among all frames of a data set, whether they are chosen or not.

    Frames with cars are taken evenly from all frames, at most 60 for each rig, until the field is known to 0.06 px in
    the middle of the cars. Files that cannot be read are skipped here; the refinement reports them later. The evidence
    is added to the known `rigs`, and new rigs join the list. `tell` gets the name of each frame. Of a data set without
    detections the sizes of cars are the evidence.
    """
    plain, rigs = replace(dataset, ground="camera_height", disparity_fields=()), [] if rigs is None else rigs
    for frame_ids in _frames_by_rig(plain):
        _take_in(plain, frame_ids, tell, rigs)
    return rigs


def _frames_by_rig(dataset: StereoDataset) -> list[list[str]]:
    """All frames grouped by calibration, without those whose calibration cannot be read."""
    groups: dict[bytes, list[str]] = {}
    for frame_id in dict.fromkeys([*dataset.layout.frame_ids(), *dataset.frame_ids]):
        with suppress(DirectShapeError, OSError):
            calibration = dataset.layout.files(frame_id).read_calibration()
            groups.setdefault(calibration.P2.tobytes() + calibration.P3.tobytes(), []).append(frame_id)
    return list(groups.values())


def _take_in(
    dataset: StereoDataset, frame_ids: Sequence[str], tell: Callable[[str], object], rigs: list[RigEstimate]
) -> None:
    rig, num_seen = _rig_of_first(dataset, frame_ids, rigs), 0
    if rig is None:
        return
    for frame_id in evenly(frame_ids):
        with suppress(DirectShapeError, OSError):
            if not _may_have_cars(dataset, frame_id):
                continue
            loaded = dataset.load(frame_id)
            if not len(loaded.detections):
                continue
            rig.update(loaded.frame, loaded.detections)
            num_seen += 1
            tell(frame_id)
            if num_seen == _MOST_FRAMES or rig.in_the_middle()[1] < _SIGMA_PX:
                break


def _may_have_cars(dataset: StereoDataset, frame_id: str) -> bool:
    """Whether a frame has detections of the chosen classes, or can have masks; its images are not read for this."""
    if dataset.has_detections or dataset.masks is None:
        return any(found.type in dataset.classes for found in dataset.objects(frame_id))
    paths = dataset.masks.files(frame_id)
    return not paths or any(path.is_file() for path in paths)


def _rig_of_first(dataset: StereoDataset, frame_ids: Sequence[str], rigs: list[RigEstimate]) -> RigEstimate | None:
    """The rig of the first frame whose left image can be read; the frames need not have cars."""
    for frame_id in frame_ids:
        with suppress(DirectShapeError, OSError):
            files = dataset.layout.files(frame_id)
            height, width = read_rgb(files.left).shape[:2]
            camera = to_stereo_camera(files.read_calibration())
            return rig_among(rigs, Rig.of(camera, (width, height)))
    return None


def evenly(frame_ids: Sequence[str]) -> list[str]:
    """All frames in the order of their bit-reversed numbers, so that the first N are spread over the whole."""
    num_bits = max(1, (len(frame_ids) - 1).bit_length())
    return [frame_ids[k] for k in sorted(range(len(frame_ids)), key=lambda k: f"{k:0{num_bits}b}"[::-1])]


def truth_files(root: Path, source: TruthSource) -> dict[str, Path]:
    """Files of a source by frame id; the id of a first image of KITTI stereo 2015 is its full name `NNNNNN_10`."""
    folders, ending = (("disp_noc_0", "disp_occ_0"), ".png") if source == "disparity" else (("velodyne",), ".bin")
    found = (path for folder in folders for path in visible_files(root / "training" / folder, [ending]))
    files = {path.stem: path for path in found}
    if not files:
        wanted = " or ".join(f"training/{folder}/*{ending}" for folder in folders)
        cure = f"choose one of --from {', '.join(get_args(TruthSource))}"
        raise DataFormatError(root, f"holds no {wanted}", cure=cure)
    return dict(sorted(files.items()))


def observe_frame(files: FrameFiles, truth: Path, source: TruthSource) -> Frame:
    """Read one frame and measure its disparities where the truth is known."""
    calibration, (left, right) = files.read_calibration(), read_pair(files.left, files.right)
    rig = Rig.of(to_stereo_camera(calibration), (left.shape[1], left.shape[0]))
    known = _of_map(truth, rig) if source == "disparity" else known_depth_from_lidar(truth, calibration, rig)
    return rig, observe_disparity(MatchedPair.of(left, right), rig, known)


def add_truth(rigs: list[RigEstimate], source: TruthSource, frames: Sequence[Frame]) -> None:
    """Add the evidence of observed frames to the estimates of their rigs; new rigs join the list."""
    of_rig: dict[RigEstimate, list[Frame]] = {}
    for frame in frames:
        of_rig.setdefault(rig_among(rigs, frame[0]), []).append(frame)
    for estimate, seen in of_rig.items():
        observations = torch.cat([observed for _, observed in seen])
        estimate.add_pixels(source, pixel_evidence(observations, seen[0][0].size_wh, len(seen)))


def known_depth_from_lidar(path: Path, calibration: KittiCalibration, rig: Rig) -> Tensor:
    """Scan points (P, 3) in the left image that are not hidden from the camera: u, v, depth."""
    points_cam = read_scan(path, calibration)
    points_cam = points_cam[(points_cam[:, 2] > _DEPTH_RANGE_M[0]) & (points_cam[:, 2] < _DEPTH_RANGE_M[1])]
    known = torch.cat([project(points_cam, rig.K_left), points_cam[:, 2:]], dim=1)
    limit = torch.tensor(rig.size_wh, dtype=torch.float64) - 1
    known = known[((known[:, :2] >= 0) & (known[:, :2] <= limit)).all(dim=-1)]
    return known[~_hidden(known[:, :2], rig.displacement(known[:, :2], known[:, 2])[:, 0], rig.size_wh)]


def _of_map(path: Path, rig: Rig) -> Tensor:
    """Pixels (P, 3) with known true disparity: u, v, depth."""
    disparity = torch.from_numpy(read_disparity(path, (rig.size_wh[1], rig.size_wh[0]))).double()
    v, u = torch.nonzero(disparity.isfinite(), as_tuple=True)
    uv = torch.stack([u, v], dim=-1).double()
    known = torch.cat([uv, rig.depth(uv, disparity[v, u])[:, None]], dim=1)
    return known[known[:, 2].isfinite()]


def _hidden(uv: Tensor, disparity: Tensor, size_wh: tuple[int, int]) -> Tensor:
    """Whether (P,) a much nearer point lies close to each point in the image."""
    import cv2

    column, row = uv[:, 0].round().long().numpy(), uv[:, 1].round().long().numpy()
    nearest: NDArray[np.float32] = np.zeros((size_wh[1], size_wh[0]), np.float32)
    np.maximum.at(nearest, (row, column), disparity.numpy().astype(np.float32))
    kernel = np.ones((2 * _WINDOW_PX + 1, 2 * _WINDOW_PX + 1), np.uint8)
    around = np.asarray(cv2.dilate(nearest, kernel))[row, column]
    return torch.from_numpy(around).double() > disparity + _HIDDEN_BY_PX


def open_sequence(root: Path, frames: Sequence[int | str] | None = None) -> dict[str, FrameFiles]:
    """The frames of a sequence of KITTI's tracking benchmark, in their order in time.

    `frames` are ids of consecutive frames of a moving car, None for all. Raises `DataFormatError` for a file that is
    missing, `InputError` for fewer than two frames.
    """
    layout = tracking_layout(root, root)
    known = layout.image_ids()
    chosen = known if frames is None else frames_among(known, frames, "ids of images")
    # The order holds for numbers with and without leading zeros.
    found = {frame_id: layout.files(frame_id) for frame_id in sorted(chosen, key=lambda name: (len(name), name))}
    if len({layout.sequence_of(frame_id) for frame_id in found}) > 1 or len(found) < 2:
        cure = "give the folder of one sequence, and more frames"
        raise InputError("frames", "at least two consecutive frames of one sequence", str(len(found)), cure)
    # A missing image is reported now, before minutes of work on other frames.
    if lonely := [frame_id for frame_id, files in found.items() if not files.right.is_file()]:
        cure = "add the right image of every frame, or leave frames out with --frames"
        raise DataFormatError(root / "image_03", f"has no image of {', '.join(lonely[:5])}", cure=cure)
    return found


def gaps(frame_ids: Sequence[str]) -> list[tuple[str, str]]:
    """Neighbours whose numbers are farther apart than the closest pair's; none if an id is not a number."""
    if not all(frame_id.isdecimal() for frame_id in frame_ids):
        return []
    pairs = {(before, after): int(after) - int(before) for before, after in pairwise(frame_ids)}
    return [pair for pair, step in pairs.items() if step > min(pairs.values())]


def observe_motion(frames: Iterable[FrameFiles], height_m: float | None) -> list[FieldConstraint]:
    """Read frames of one rig one after the other and collect constraints; constraints of the road need `height_m`.

    The caller may pass an iterator that shows progress.
    """
    constraints: list[FieldConstraint] = []
    waiting: deque[StereoFeatures] = deque(maxlen=max(STEPS) + 1)
    for files in frames:
        left, right = read_pair(files.left, files.right)
        camera = to_stereo_camera(files.read_calibration())
        rig = Rig.of(camera, (left.shape[1], left.shape[0]))
        if waiting and waiting[0].rig.size_wh != rig.size_wh:
            (width, height), before = rig.size_wh, waiting[0].rig.size_wh
            problem = f"is {width} x {height}, the frames before it {before[0]} x {before[1]}"
            raise DataFormatError(files.left, problem, cure="give frames of one rig")
        pair = MatchedPair.of(left, right)
        road = None if height_m is None else find_road(pair, rig, height_m)
        constraints += [] if road is None else [road]
        waiting.append(find_features(left, pair, rig))
        if len(waiting) == waiting.maxlen:
            constraints += _of_first(waiting)
    # Fewer frames follow the last ones.
    while waiting:
        constraints += _of_first(waiting)
    return constraints


def _of_first(waiting: deque[StereoFeatures]) -> Sequence[FieldConstraint]:
    """Remove the first frame and find its points in the frames that follow it."""
    first = waiting.popleft()
    return track_features(first, [features.grey_left for features in waiting])
