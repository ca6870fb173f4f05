"""This module loads the frames that are refined."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import directshape_torch
from directshape_torch.errors import InputError
from directshape_torch.io.stereo_dataset import LoadedFrame

_DETECTORS = {"rendered": "stereo", "kitti": "noisy_stereo", "kitti15": "noisy_stereo"}
_SCENES = "rendered", "kitti"


@dataclass(frozen=True)
class Scene:
    """A `Scene` has the frames of one data set, with at least one car each."""

    name: str
    frames: tuple[LoadedFrame, ...]


def load_scenes(
    data_root: Path | None, max_frames: int | None = None, names: Sequence[str] = _SCENES
) -> tuple[Scene, ...]:
    """The rendered and the KITTI frames below a data folder, or the bundled demo frame without a folder.

    Args:
        data_root: folder with data sets (DIRECTSHAPE_DATA), or None.
        max_frames: number of first frames of each data set; None for all.
        names: the data sets.

    Raises:
        InputError: the folder has none of them.
    """
    if data_root is None:
        return (demo_scene(),)
    found = [(data_root / name, _DETECTORS[name]) for name in names if (data_root / name).is_dir()]
    if not found:
        cure = "or leave both out for the bundled frame"
        raise InputError(
            "--data or DIRECTSHAPE_DATA", f"a folder that holds {' or '.join(names)}", str(data_root), cure
        )
    return tuple(_scene(root, detector, max_frames) for root, detector in found)


def demo_scene() -> Scene:
    """The bundled frame with six cars."""
    return _scene(Path(directshape_torch.__file__).parent / "assets" / "demo", "noisy_stereo", None)


def _scene(root: Path, detector: str, max_frames: int | None) -> Scene:
    where = root, root / "detections" / detector, root / "training" / "masks"
    try:
        from directshape_torch.io.stereo_dataset import open_dataset
    except ImportError:  # in an older version, which is compared with this one, a layout is a class
        from directshape_torch.io.kitti_dataset import KittiStereoDataset  # type: ignore[import-not-found]

        dataset = KittiStereoDataset(*where)
    else:
        dataset = open_dataset("kitti", *where)
    loaded = (dataset.load(frame_id) for frame_id in dataset.frame_ids)
    with_cars = (frame for frame in loaded if len(frame.detections))
    return Scene(root.name, tuple(itertools.islice(with_cars, max_frames)))
