"""Whether images and boxes agree: by how many pixels disparities are off, and depths by how many percent."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from directshape_torch.errors import DirectShapeError
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.rig.estimate import RigEstimate, rig_among
from directshape_torch.rig.rig import Rig
from directshape_torch.scene_check.finding import Finding

FEWEST_CARS = 8
# 0.15 px are 0.35 m at 30 m on KITTI's rig.
LARGEST_OFFSET_PX, LARGEST_BIAS = 0.15, 0.03
_SURE = 2.0  # standard deviations


def check_rig(dataset: StereoDataset, frame_ids: Sequence[str]) -> list[Finding]:
    """What the detections of some frames say of their rigs beyond the disparity fields that the data set has."""
    plain, rigs = replace(dataset, ground="camera_height", disparity_fields=()), list[RigEstimate]()
    for frame_id in frame_ids:
        # What cannot be read was found before.
        with suppress(DirectShapeError, OSError):
            loaded = plain.load(frame_id)
            rig_among(rigs, Rig.of_frame(loaded.frame)).update(loaded.frame, loaded.detections)
    enough = [rig for rig in rigs if len(rig.rows) >= FEWEST_CARS]
    return [found for rig in enough for found in (*_offset(rig, dataset), *_bias(rig))]


def _offset(rig: RigEstimate, dataset: StereoDataset) -> list[Finding]:
    place = rig.rows[:, :2].median(dim=0).values
    offset, sigma = (float(x) for x in rig.offset_at(place))
    known = sum(float(field.bias(place)) for field in dataset.disparity_fields if rig.is_of(*field.rig))
    rest = offset - known
    if abs(rest) < max(LARGEST_OFFSET_PX, _SURE * sigma):
        return []
    return [
        Finding(
            "rig_offset",
            "warning",
            f"{len(rig.rows)} cars",
            f"disparities differ from those of the boxes by {rest:+.2f} +- {sigma:.2f} px in the middle of the cars, "
            f"{abs(rest) * rig.metres_per_pixel(30.0):.1f} m at 30 m",
            f"within {LARGEST_OFFSET_PX} px",
            "nothing for 'directshape refine', which estimates it (--rig auto); for more evidence: 'calibrate-rig'",
        )
    ]


def _bias(rig: RigEstimate) -> list[Finding]:
    detector = rig.detector
    if abs(detector.bias) < max(LARGEST_BIAS, _SURE * detector.bias_sigma):
        return []
    side = "near" if detector.bias < 0 else "far"
    return [
        Finding(
            "detector_bias",
            "warning",
            f"{detector.num_cars} cars",
            f"boxes stand {abs(detector.bias):.1%} +- {detector.bias_sigma:.1%} too {side}".replace("%", " %"),
            f"within {LARGEST_BIAS:.0%}".replace("%", " %"),
            "check focal length and baseline, or the detector's training; 'directshape refine' goes by the images",
        )
    ]
