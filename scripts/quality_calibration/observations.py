"""Refined cars with truth: what was known of each at run time, and what became of its box."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.files.array_files import read_npz
from directshape_torch.geometry.box3d import rotation_y_from_pose, wrap_angle
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset
from directshape_torch.refinement.quality import EVIDENCE_NAMES
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.scene import Detections
from quality_calibration.bend import Bend
from quality_calibration.noise import LEVELS, NoiseLevel, noisy

Array = NDArray[np.floating[Any]]
WORSE_BY = 0.05


@dataclass(frozen=True)
class Observations:
    """N refined cars."""

    group: NDArray[np.str_]  # (N,) text, frame; cars of one group are never on both sides of a split
    source: NDArray[np.str_]  # (N,) text: detector and masks
    evidence: Array  # (N, E)
    iou_before: Array  # (N,) bird's-eye overlap of input and refined box with the label
    iou_after: Array
    errors: Array  # (N, 4) refined minus true x, y, z (bottom centre, ref) and heading (modulo pi)
    covariance: Array  # (N, 4, 4) of them, uncalibrated
    ray: Array  # (N, 2) x and z of the viewing ray's unit vector

    def __len__(self) -> int:
        return len(self.group)

    def where(self, condition: NDArray[np.bool_]) -> Observations:
        """Those for which the condition (N,) holds."""
        return Observations(**{f.name: getattr(self, f.name)[condition] for f in fields(self)})

    @property
    def is_better(self) -> NDArray[np.bool_]:
        """(N,) whose overlap grew."""
        return np.asarray(self.iou_after > self.iou_before)

    @property
    def is_worse(self) -> NDArray[np.bool_]:
        """(N,) made worse by more than 0.05."""
        return np.asarray(self.iou_after < self.iou_before - WORSE_BY)

    @classmethod
    def joined(cls, parts: Sequence[Observations]) -> Observations:
        """All of several sets."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def save(self, path: Path) -> None:
        """Keep them for another fit; refining is what takes the time."""
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Observations:
        """Those of `save`.

        Raises:
            DataFormatError: their evidence has the columns of another version.
        """
        arrays = read_npz(path)
        known, wanted = arrays["evidence"].shape[1:], (len(EVIDENCE_NAMES),)
        if known != wanted:
            cure = "delete it, and its cars are refined again"
            raise DataFormatError(path, f"has evidence {known} of each car, this version's is {wanted}", cure=cure)
        return cls(**{f.name: arrays[f.name] for f in fields(cls)})


@dataclass(frozen=True)
class Conditions:
    """Of the run of one seed."""

    field_px: float  # largest errors of the rig's disparities and rows
    rows_px: float
    has_right_masks: bool  # False: the left ones alone


CONDITIONS = (Conditions(0.0, 0.0, True), Conditions(0.6, 0.2, True), Conditions(1.2, 0.3, False))
"""Of seeds 0, 1, 2, 3 = 0 again ..: an exact rig, and two that are not."""

# A run looks at so many of its frames to learn of the rig: about 60 detections, as `refine` sees of a small data set.
_FRAMES_OF_RIG = 12


def observe_noisy(
    dataset: StereoDataset,
    refiner: Callable[[RigEstimate], DirectShapeRefiner],
    levels: Sequence[NoiseLevel],
    seeds: Sequence[int],
    masks_name: str,
    report: Callable[[str], None],
) -> Observations:
    """Refine the labelled cars of all frames from detections of several noise levels and seeds, with rigs that the runs
    have learnt of themselves."""
    parts = []
    for seed in seeds:
        for level in levels:
            source = f"{level.name}, {masks_name}, seed {seed}"
            refine = refiner(_rig_of_run(dataset, level, seed))
            for number in range(len(dataset.frame_ids)):
                loaded, drawn = _drawn(dataset, number, level, seed)
                parts += observe(loaded, drawn, refine, source)
            report(f"{source}: done")
    return Observations.joined(parts)


def _rig_of_run(dataset: StereoDataset, level: NoiseLevel, seed: int) -> RigEstimate:
    rig: RigEstimate | None = None
    for number in range(0, len(dataset.frame_ids), max(1, len(dataset.frame_ids) // _FRAMES_OF_RIG)):
        loaded, drawn = _drawn(dataset, number, level, seed)
        rig = RigEstimate.of_frames(loaded.frame) if rig is None else rig
        rig.update(loaded.frame, drawn)
    assert rig is not None
    return rig


def _drawn(dataset: StereoDataset, number: int, level: NoiseLevel, seed: int) -> tuple[LoadedFrame, Detections]:
    """A frame as the rig of that seed shows it, with what a detector says of it."""
    loaded, now = dataset.load(dataset.frame_ids[number]), CONDITIONS[seed % len(CONDITIONS)]
    drawn = noisy(loaded.detections, level, 10_000 * seed + 100 * number + LEVELS.index(level))
    if now.field_px:
        height, width = loaded.frame.sizes[0].tolist()
        bend = Bend.drawn(now.field_px, now.rows_px, (width, height), seed)
        loaded, drawn = replace(loaded, frame=bend.frames(loaded.frame)), bend.masks(drawn)
    if not now.has_right_masks:
        drawn = replace(drawn, mask_right=drawn.mask_right.where(torch.zeros_like(drawn.has_mask_right)))
    return loaded, drawn


def observe_dataset(dataset: StereoDataset, refiner: DirectShapeRefiner, source: str) -> Observations:
    """Refine the detections of a data set as they are."""
    frames: Iterable[LoadedFrame] = (dataset.load(frame_id) for frame_id in dataset.frame_ids)
    return Observations.joined([part for f in frames for part in observe(f, f.detections, refiner, source)])


def observe(
    loaded: LoadedFrame, detections: Detections, refiner: DirectShapeRefiner, source: str
) -> list[Observations]:
    """The counted, refined cars of one frame, whose detections may have been replaced; none, or one set."""
    result = refiner(loaded.frame, detections)
    assert loaded.labels is not None
    refined, masked = result.refined.tolist(), loaded.detections.has_mask_left.tolist()
    found = match_to_labels(loaded.detected_objects, loaded.labels)
    rows = [row for row, label in found.items() if refined[row] and masked[row] and is_counted(label)]
    if not rows:
        return []
    truth, after = boxes_of([found[row] for row in rows]), result.to_boxes("kitti", "ref")[rows].double()
    errors = (after - truth)[:, [0, 1, 2, 6]]
    # A flip by half a turn is the detector's affair: the sigma of the heading does not speak of it.
    errors[:, 3] = wrap_angle(2 * errors[:, 3]) / 2
    ray = truth[:, [0, 2]] / truth[:, [0, 2]].norm(dim=1, keepdim=True)
    location = detections.T_cam_obj[:, :3, 3] - result.t_cam_ref
    yaw = rotation_y_from_pose(detections.T_cam_obj)
    before = torch.cat([location, detections.dimensions_hwl, yaw[:, None]], 1)[rows].double()
    columns = (
        np.array([loaded.frame_id] * len(rows)),
        np.array([source] * len(rows)),
        result.quality.evidence[rows].numpy(),
        pose_errors(before, truth).bev_iou.numpy(),
        pose_errors(after, truth).bev_iou.numpy(),
        errors.numpy(),
        result.covariance_xyz_yaw[rows].numpy(),
        ray.numpy(),
    )
    return [Observations(*columns)]
