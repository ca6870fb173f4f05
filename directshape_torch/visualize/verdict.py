"""This module judges a run without labels: how many boxes it improved, how certain that is, and what to check first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.status import Status

_NAMED = 5
_AT_M = 30.0
# Boxes that were good become worse if the error of a rig moves cars at 30 m by more than this.
_LARGE_M = 0.4


def verdict(frames: Mapping[str, Mapping[str, Any]], rigs: Sequence[RigEstimate]) -> list[str]:
    """Sentences about the entries of frames and about the rigs that the run has estimated.

    Examples:
        >>> entry = {"cars": 2, "statuses": {"converged": 2}, "better": 1.6, "worse": 0.2}
        >>> verdict({"000001": {**entry, "doubtful": {"7": [0.81, 3.9]}}}, [])[0]
        '2 of 2 boxes are refined: about 1.6 of them better than before, 0.2 worse by more than 0.05 of BEV IoU'
    """
    done = {name: entry for name, entry in frames.items() if "reason" not in entry}
    num_cars = sum(entry["cars"] for entry in done.values())
    if not num_cars:
        return []
    refined = _count(done, [status for status in Status if status.is_refined])
    better, worse = (sum(entry.get(name, 0.0) for entry in done.values()) for name in ("better", "worse"))
    words = f"{refined} of {num_cars} boxes are refined"
    if better or worse:
        words += f": about {better:.1f} of them better than before, {worse:.1f} worse by more than 0.05 of BEV IoU"
    names = [f"rig {number}" for number in range(1, len(rigs) + 1)] if rigs[1:] else ["the rig"]
    return [words, *_unseen(done), *map(_of_rig, names, rigs), *_doubtful(done)]


def _count(frames: Mapping[str, Mapping[str, Any]], statuses: Sequence[Status]) -> int:
    return sum(entry["statuses"].get(status.name, 0) for entry in frames.values() for status in statuses)


def _unseen(frames: Mapping[str, Mapping[str, Any]]) -> list[str]:
    count = _count(frames, [Status.mask_missed, Status.no_match, Status.no_car])
    if not count:
        return []
    return [f"the images do not show the car of {count} masks where its box is: check these masks and boxes"]


def _of_rig(name: str, rig: RigEstimate) -> str:
    _, sigma = rig.in_the_middle()
    off = f"the disparity of {name} is known to {sigma:.2f} px, so cars in one part of the image may be off alike"
    off += f", by {sigma * rig.metres_per_pixel(_AT_M):.2f} m at {_AT_M:.0f} m"
    if rig.is_guess:
        return f"{off}: {len(rig.uv_of_cars)} cars hardly show it; give more frames, or --rig FILE (docs/your_rig.md)"
    if sigma * rig.metres_per_pixel(_AT_M) > _LARGE_M:
        return f"{off}; calibrate-rig can tell it better (docs/your_rig.md)"
    return off


def _doubtful(frames: Mapping[str, Mapping[str, Any]]) -> list[str]:
    cars = [
        (float(probability), name, line, float(distance))
        for name, entry in frames.items()
        for line, (probability, distance) in entry.get("doubtful", {}).items()
    ]
    if not cars:
        return []
    named = []
    for probability, name, line, distance in sorted(cars)[:_NAMED]:
        away = f", {distance:.1f} standard deviations from its box" if distance >= 0 else ""
        named.append(f"line {line} of {name} ({1 - probability:.2f} probable to be worse{away})")
    return [f"look first (2.6 standard deviations are usual) at {'; '.join(named)}"]
