"""This module says how the refinement of a car ended; the value of a status is its message, with advice."""

from __future__ import annotations

import enum
from collections.abc import Mapping

import torch
from torch import Tensor


class Status(enum.Enum):
    """A `Status` is one car's outcome. The first two and `rescued` carry a refined state, the others the input."""

    converged = "refined: the cost settled, or a further step promises less than half a percent of it"
    max_iterations = (
        "refined: the iterations were used up while the cost still fell a little; such cars gain nearly as much as "
        "converged ones, and more iterations would change them little"
    )
    no_mask = "the car has no instance mask in the left image, which is needed; check the masks and their frame numbers"
    too_few_pixels = "fewer usable pixels than the configured minimum; the car is tiny, cut off or hidden"
    behind_camera = "the initial box lies behind or at the camera, or upside down; check frame and units of the pose"
    singular = "the normal equations are singular; add a prior, more pixels, or damping"
    non_finite = "the cost or its derivatives are not finite at the input; look for NaN in images, masks, pose, weights"
    rejected_worse = "the result had a higher cost than the input, which is returned instead"
    too_few_points = "fewer stereo points on the car than point_cloud.min_points; it is far, hidden, or badly matched"
    not_trusted = (
        "the result is too likely to be worse than the input, which is returned instead; check masks and stereo "
        "calibration, or set both probabilities of `acceptance` to 0 to have it all the same"
    )
    mask_missed = (
        "the refined shape misses the instance mask, so the input is returned; check that mask and box are of one car, "
        "and units and frame of boxes and calibration"
    )
    no_match = (
        "the car's pixels match elsewhere or nowhere in the right image, so the input is returned; check the stereo "
        "calibration, that both images are of one time, and that the mask shows the car"
    )
    depth_unknown = (
        "the images leave a fifth of the depth unknown, so the input is returned; the car is too far, or has too few "
        "pixels"
    )
    no_car = (
        "what the mask shows is probably not this car, so the input is returned: halves of it lie at different depths, "
        "it looks unlike itself in the right image, or its place is more standard deviations from the detector's than "
        "a car's is; check that mask and box are of one car, or set both probabilities of `acceptance` to 0 to have it "
        "all the same"
    )
    no_start = (
        "no box could be made of the mask: under it are too few disparities, nothing of a car's size on the road, or "
        "more than one car; check that mask and images are of one frame, and the ground plane, or give a box of a "
        "detector"
    )

    rescued = (
        "refined from a box made of the car's mask, because the given box did not lead to the car; it is far off where "
        "result.comparison.distance_in_sigmas is large, and then it is not weighed"
    )

    @property
    def code(self) -> int:
        """Stable number of the status, for tensors and files."""
        return _CODES[self]

    @property
    def is_refined(self) -> bool:
        """Whether the state differs from the input by refinement."""
        return self in (Status.converged, Status.max_iterations, Status.rescued)

    @classmethod
    def from_code(cls, code: int) -> Status:
        return _BY_CODE[code]


_BY_CODE = tuple(Status)
_CODES = {status: code for code, status in enumerate(_BY_CODE)}
_REFINED = [status.code for status in Status if status.is_refined]


def is_refined(status_code: Tensor) -> Tensor:
    """Whether the codes (B,) belong to cars that carry a refined state."""
    return torch.stack([status_code == code for code in _REFINED]).any(dim=0)


def counted(counts: Mapping[str, int]) -> str:
    """How many cars ended in which status, in words; refined cars come first.

    Examples:
        >>> counted({"max_iterations": 1, "converged": 4, "no_mask": 2})
        '5 refined (converged 4, max_iterations 1), 2 as before (no_mask 2)'
    """
    parts = []
    for what, refined in (("refined", True), ("as before", False)):
        of_these = {each.name: counts.get(each.name, 0) for each in Status if each.is_refined == refined}
        words = ", ".join(f"{name} {count}" for name, count in of_these.items() if count)
        if words:
            parts.append(f"{sum(of_these.values())} {what} ({words})")
    return ", ".join(parts) or "none"
