"""What is refined: scenes with labels, and calls of any number of cars made from one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import directshape_torch
from directshape_torch.errors import InputError
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene import Detections, FrameBatch

# The frame that the README fits the rig of the KITTI frames from.
_FRAME_OF_FIELD = "007322"


@dataclass(frozen=True)
class Scene:
    """Frames of one data set with their labels.

    Attributes:
        name: of the data set.
        labels: folder of label files.
        detections: folder of the detections that are refined.
        frames: with at least one car each.
    """

    name: str
    labels: Path
    detections: Path
    frames: tuple[LoadedFrame, ...]

    @property
    def num_cars(self) -> int:
        return sum(len(frame.detections) for frame in self.frames)


def load_scenes(data_root: Path | None, max_frames: int | None = None, with_rig: bool = True) -> tuple[Scene, ...]:
    """The rendered and the KITTI frames below a data folder, or else the bundled demo frame.

    Args:
        data_root: holds `rendered` or `kitti` (DIRECTSHAPE_DATA), or None.
        max_frames: of each, the first; None for all.
        with_rig: KITTI's frames bring the disparity field of their rig.

    Raises:
        InputError: the folder holds neither.
    """
    return tuple(_scenes(data_root, max_frames, with_rig))


def first_scene(data_root: Path | None, max_frames: int | None = None) -> Scene:
    """The first scene of `load_scenes`; the others are not read."""
    return next(_scenes(data_root, max_frames))


def _scenes(data_root: Path | None, max_frames: int | None, with_rig: bool = True) -> Iterator[Scene]:
    if data_root is None:
        yield demo_scene()
        return
    check_data_root(data_root)
    rendered, kitti = data_root / "rendered", data_root / "kitti"
    if rendered.is_dir():
        yield _scene(rendered, "stereo", None, max_frames)
    if kitti.is_dir():
        yield _scene(kitti, "noisy_stereo", _rig_field(kitti) if with_rig else None, max_frames)


def check_data_root(data_root: Path) -> None:
    """Raise `InputError` unless a data folder holds rendered or KITTI frames."""
    if not (data_root / "rendered").is_dir() and not (data_root / "kitti").is_dir():
        cure = "or leave both out for the bundled frame"
        raise InputError("--data or DIRECTSHAPE_DATA", "a folder that holds rendered or kitti", str(data_root), cure)


def demo_scene() -> Scene:
    """The bundled frame with six cars."""
    return _scene(Path(directshape_torch.__file__).parent / "assets" / "demo", "noisy_stereo", None, None)


def _scene(root: Path, detector: str, field: Any, max_frames: int | None) -> Scene:
    detections, masks = root / "detections" / detector, root / "training" / "masks"
    dataset = KittiStereoDataset(root, detections, masks, disparity_field=field)
    frames: list[LoadedFrame] = []
    for frame_id in dataset.frame_ids:
        if max_frames is not None and len(frames) == max_frames:
            break
        loaded = dataset.load(frame_id)
        if len(loaded.detections):
            frames.append(loaded)
    return Scene(root.name, root / "training" / "label_2", detections, tuple(frames))


def _rig_field(root: Path) -> Any:
    """A `DisparityField`, as `directshape calibrate-rig --from disparity --frames 007322` fits it."""
    # Here, for what `--against` compares with may have no such module.
    from directshape_torch.rig.estimate import RigEstimate
    from directshape_torch.rig.frames_with_truth import add_truth, observe_frame, truth_files

    frame = observe_frame(root, _FRAME_OF_FIELD, truth_files(root, "disparity")[_FRAME_OF_FIELD], "disparity")
    rigs: list[RigEstimate] = []
    add_truth(rigs, "disparity", [frame])
    return rigs[0].field


def with_cars(frames: Sequence[LoadedFrame], num_cars: int) -> tuple[FrameBatch, Detections]:
    """One call of exactly so many cars: the frames over and over, of the last one its first cars.

    Raises:
        InputError: no cars to repeat.
    """
    if not sum(len(frame.detections) for frame in frames):
        raise InputError("frames", "at least one car", "none")
    chosen: list[LoadedFrame] = []
    missing = num_cars
    while missing > 0:
        loaded = frames[len(chosen) % len(frames)]
        chosen.append(first_cars(loaded, min(missing, len(loaded.detections))))
        missing -= len(chosen[-1].detections)
    return collate(chosen)


def first_cars(loaded: LoadedFrame, count: int) -> LoadedFrame:
    """A frame of which only the first cars are refined; the others are not there, so that they hide nothing either."""
    return replace(loaded, detections=_rows(loaded.detections, slice(0, count)))


def _rows(detections: Detections, rows: slice) -> Detections:
    names = ("frame_index", "T_cam_obj", "dimensions_hwl", "box_2d", "score", "mask_left", "mask_right")
    kept = {name: getattr(detections, name)[rows] for name in (*names, "has_mask_left", "has_mask_right")}
    sigma = None if detections.pose_sigma is None else detections.pose_sigma[rows]
    return replace(detections, pose_sigma=sigma, **kept)
