"""The rigs of a data set, from a sample of its frames and what its detector says of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import torch

from directshape_torch.errors import DirectShapeError
from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.kitti_calibration import to_stereo_camera
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.rig.estimate import RigEstimate, rig_among
from directshape_torch.rig.rig import Rig

# Half a second each, and an estimate from detections hardly gets better than that.
_MOST_FRAMES = 60
_SIGMA_PX = 0.06


def estimate_rigs(
    dataset: StereoDataset,
    tell: Callable[[str], object] = lambda _: None,
    rigs: list[RigEstimate] | None = None,
) -> list[RigEstimate]:
    """One estimate for each calibration among the frames of a data set, whichever of them are chosen.

    Frames with cars are taken evenly from all of them, at most 60 a rig, until the field is known to 0.06 px in the
    middle of the cars. What cannot be read is passed over: it is reported when its turn comes.

    Args:
        dataset: a disparity field of its own is not used.
        tell: called with the name of each frame that was looked at.
        rigs: what is known already; the evidence is added to these, and new rigs join the list.
    """
    plain, rigs = replace(dataset, ground="camera_height", disparity_fields=()), [] if rigs is None else rigs
    for frame_ids in _frames_by_rig(plain):
        _take_in(plain, frame_ids, tell, rigs)
    return rigs


def _frames_by_rig(dataset: StereoDataset) -> list[list[str]]:
    """All frames that have detections, chosen or not, those of one calibration together.

    Frames whose calibration cannot be read are left out.
    """
    groups: dict[bytes, list[str]] = {}
    for frame_id in dict.fromkeys([*dataset.layout.frame_ids(), *dataset.frame_ids]):
        with suppress(DirectShapeError, OSError):
            calibration = dataset.layout.calibration(frame_id)
            groups.setdefault(calibration.P2.tobytes() + calibration.P3.tobytes(), []).append(frame_id)
    return list(groups.values())


def _take_in(
    dataset: StereoDataset, frame_ids: Sequence[str], tell: Callable[[str], object], rigs: list[RigEstimate]
) -> None:
    rig, num_seen = _rig_of_first(dataset, frame_ids, rigs), 0
    if rig is None:
        return
    for frame_id in _evenly(frame_ids):
        with suppress(DirectShapeError, OSError):
            if not any(found.type in dataset.classes for found in dataset.objects(frame_id)):
                continue
            loaded = dataset.load(frame_id)
            rig.update(loaded.frame, loaded.detections)
            num_seen += 1
            tell(frame_id)
            if num_seen == _MOST_FRAMES or rig.in_the_middle()[1] < _SIGMA_PX:
                break


def _rig_of_first(dataset: StereoDataset, frame_ids: Sequence[str], rigs: list[RigEstimate]) -> RigEstimate | None:
    """That of the first frame whose left image can be read; a rig whose frames have no cars is one too."""
    for frame_id in frame_ids:
        with suppress(DirectShapeError, OSError):
            height, width = read_rgb(dataset.layout.images(frame_id)[0]).shape[:2]
            camera = to_stereo_camera([dataset.layout.calibration(frame_id)], dtype=torch.float64)
            return rig_among(rigs, Rig.of(camera, (width, height)))
    return None


def _evenly(frame_ids: Sequence[str]) -> list[str]:
    """All of them, so that the first N are spread over the whole: in the order of their bit-reversed numbers.

    Examples:
        >>> "".join(_evenly("abcdefgh"))
        'aecgbfdh'
    """
    num_bits = max(1, (len(frame_ids) - 1).bit_length())
    return [frame_ids[k] for k in sorted(range(len(frame_ids)), key=lambda k: f"{k:0{num_bits}b}"[::-1])]
