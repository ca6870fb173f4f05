"""What is refined: scenes, and calls of any number of cars made from one frame."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import directshape_torch
from directshape_torch.errors import InputError
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene import Detections, FrameBatch

_DETECTORS = {"rendered": "stereo", "kitti": "noisy_stereo"}


@dataclass(frozen=True)
class Scene:
    """Frames of one data set, with at least one car each."""

    name: str
    frames: tuple[LoadedFrame, ...]


def load_scenes(data_root: Path | None, max_frames: int | None = None) -> tuple[Scene, ...]:
    """The rendered and the KITTI frames below a data folder, or else the bundled demo frame.

    Args:
        data_root: holds `rendered` or `kitti` (DIRECTSHAPE_DATA), or None.
        max_frames: of each, the first; None for all.

    Raises:
        InputError: the folder holds neither.
    """
    if data_root is None:
        return (demo_scene(),)
    found = [(data_root / name, detector) for name, detector in _DETECTORS.items() if (data_root / name).is_dir()]
    if not found:
        cure = "or leave both out for the bundled frame"
        raise InputError("--data or DIRECTSHAPE_DATA", "a folder that holds rendered or kitti", str(data_root), cure)
    return tuple(_scene(root, detector, max_frames) for root, detector in found)


def demo_scene() -> Scene:
    """The bundled frame with six cars."""
    return _scene(Path(directshape_torch.__file__).parent / "assets" / "demo", "noisy_stereo", None)


def _scene(root: Path, detector: str, max_frames: int | None) -> Scene:
    where = root, root / "detections" / detector, root / "training" / "masks"
    try:
        from directshape_torch.io.stereo_dataset import open_dataset
    except ImportError:  # in an older version, which this one is compared with, a layout is a class
        from directshape_torch.io.kitti_dataset import KittiStereoDataset  # type: ignore[import-not-found]

        dataset = KittiStereoDataset(*where)
    else:
        dataset = open_dataset("kitti", *where)
    loaded = (dataset.load(frame_id) for frame_id in dataset.frame_ids)
    with_cars = (frame for frame in loaded if len(frame.detections))
    return Scene(root.name, tuple(itertools.islice(with_cars, max_frames)))


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
