"""This module tells whether a shape looks like a car by its stated axes and unit, and else by which ones it would.

Passenger cars of every type share a few traits. Left and right are mirror images of each other, as no other two sides
are. A car is longer than wide and high. Seen from the front, the road shows between the wheels, and the roof blocks the
view above them. The part above half the height has its centre behind the middle of the length, or at the middle in
pick-ups. A shape is checked for these traits in each of its 24 turns by right angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from directshape_torch.errors import UnlikelyMeshError
from directshape_torch.shape.outlines import AXES, Array, Mask, Outlines

UNITS_M = {
    "metres": 1.0,
    "millimetres": 0.001,
    "centimetres": 0.01,
    "inches": 0.0254,
    "feet": 0.3048,
    "decimetres": 0.1,
}
UNITS_M |= {"hundreds of metres": 100.0, "kilometres": 1000.0}

# Real and parametric cars are 3.3 to 5.7 m long, 1.5 to 2.6 m wide and 1.0 to 2.2 m high.
_LENGTHS_M, _WIDTHS_M, _HEIGHTS_M = (2.4, 6.2), (1.1, 2.8), (0.9, 2.5)
# Length to width of cars is 1.7 to 3.1, height to width is 0.59 to 1.24, and length to height is 1.6 to 3.8.
_LENGTH_TO_WIDTH, _HEIGHT_TO_WIDTH, _LENGTH_TO_HEIGHT = (1.55, 3.3), (0.5, 1.4), (1.5, 4.3)
# A real car and its left-right mirror image overlap by 0.98 or more; mirrored at other sides by 0.88 at most.
_LEAST_OVERLAP = 0.93
# Measured from the rear, the part above half the height has its centre at 0.36 to 0.47 of the length in most cars, and
# at 0.49 to 0.541 in pick-ups.
_FOREMOST_ROOF = 0.543
# A gap under the car of this size or more is clear; it is 1 for every real and parametric car.
_CLEAR_GAP = 0.5
_USUAL_LENGTH_M = 4.2
_SMALLEST = 1e-300


@dataclass(frozen=True)
class Looks:
    """`Looks` holds the traits of a shape in one turn."""

    forward: str  # the shape's axes to the front and up, as "+x"
    up: str
    size_lwh: Array  # (3,) length, width, height in the units of the shape
    overlap: float  # overlap of the outlines with their left-right mirror images, 0 .. 1
    gap_below: float  # how much more of the middle is open at the ground than at the roof, seen from the front, -1 .. 1
    is_upright: bool
    roof: float  # centre of the part above half the height: 0 at the rear, 1 at the front

    @property
    def has_the_sizes_of_a_car(self) -> bool:
        length, width, height = np.maximum(self.size_lwh, _SMALLEST)
        ratios = length / width, height / width, length / height
        bounds = _LENGTH_TO_WIDTH, _HEIGHT_TO_WIDTH, _LENGTH_TO_HEIGHT
        return all(low <= ratio <= high for ratio, (low, high) in zip(ratios, bounds, strict=True))

    @property
    def is_a_car(self) -> bool:
        """Whether every trait but the size in metres fits a car."""
        return (
            self.has_the_sizes_of_a_car
            and self.overlap >= _LEAST_OVERLAP
            and self.is_upright
            and self.roof <= _FOREMOST_ROOF
        )


def looks_of(outlines: Outlines, forward: str, up: str) -> Looks:
    """The traits of a shape whose given axes point to the front and up."""
    side = "+" + _third_axis(forward, up)
    profile, front, top = outlines.seen(forward, up), outlines.seen(side, up), outlines.seen(forward, side)
    size_lwh = outlines.size[[AXES[forward], AXES[side], AXES[up]]]
    overlap = min(_overlap_with_mirror_image(_closed(front, 1)), _overlap_with_mirror_image(_closed(top, 0).T))
    gap = _gap_below(front)
    is_upright = gap > 0 if abs(gap) >= _CLEAR_GAP else _has_room_above(profile)
    return Looks(forward, up, size_lwh, overlap, gap, is_upright, _roof_centre(_closed(profile, 1)))


def all_looks(outlines: Outlines) -> list[Looks]:
    """The traits of a shape in each of its 24 turns."""
    pairs = ((forward, up) for forward, up in permutations(AXES, 2) if AXES[forward] != AXES[up])
    return [looks_of(outlines, forward, up) for forward, up in pairs]


def turns_to_a_car(outlines: Outlines) -> list[Looks]:
    """All turns in which a shape looks like a car; a shape that looks alike from front and rear has several."""
    return [looks for looks in all_looks(outlines) if looks.is_a_car]


def is_half_a_car(outlines: Outlines) -> bool:
    """Whether a shape is a car's left or right half: with its mirror image beyond one side it is a car with wheels."""
    cut = [looks for looks in all_looks(outlines) if looks.overlap < _LEAST_OVERLAP]
    for looks, sign in product(cut, "+-"):
        side = sign + _third_axis(looks.forward, looks.up)
        both = looks_of(outlines.doubled(side), looks.forward, looks.up)
        if both.is_a_car and both.gap_below >= _CLEAR_GAP:
            return True
    return False


def check_looks(
    outlines: Outlines, forward: str, up: str, scale: float = 1.0, length_m: float | None = None, *, name: str
) -> None:
    """Refuse a shape that does not look like a passenger car by its stated axes and unit.

    Args:
        outlines: outlines of the shape, in its own axes and unit.
        forward: stated axis of the shape that points to the front, as "+x".
        up: stated axis of the shape that points upwards.
        scale: stated length of the shape's unit, metres.
        length_m: length to which the shape will be scaled; None keeps its own.
        name: name of the shape, for the message.

    Raises:
        UnlikelyMeshError: the sizes, the left-right symmetry, the wheels or the roof do not fit a car; the error says
            by which axes and scale they would.

    Examples:
        >>> import trimesh
        >>> box = trimesh.creation.box((4.0, 1.8, 1.4))
        >>> check_looks(Outlines.of_triangles(box.triangles), "+x", "+z", name="a box")
        >>> try:
        ...     check_looks(Outlines.of_triangles(box.triangles), "+y", "+z", scale=0.001, name="a box")
        ... except UnlikelyMeshError as problem:
        ...     problem.cure
        {'forward_axis': '+x', 'up_axis': '+z', 'scale': 1.0}
    """
    now = looks_of(outlines, forward, up)
    factor = scale if length_m is None else length_m / max(float(now.size_lwh[0]), _SMALLEST)
    length, width, height = (f"{factor * size:.4g} m" for size in now.size_lwh)
    measured = f"{name}: {length} long, {width} wide and {height} high by its axes and scale"
    turns = [now] if now.is_a_car else turns_to_a_car(outlines)
    if not turns:
        raise _no_car(outlines, measured)
    wanted = min(turns, key=lambda looks: (looks.up != up, looks.roof))
    cure, stands, alike = {}, "", ""
    if wanted is not now:
        cure = {"forward_axis": wanted.forward, "up_axis": wanted.up}
        stands = f" {posture(wanted, forward, up)}"
        alike = ", whose front and rear look alike" if len(turns) > 1 else ""
    size_cure, unit = _cure_of_size(wanted.size_lwh, scale, length_m)
    if cure or size_cure:
        raise UnlikelyMeshError(f"{measured}: it looks like a car{stands}{unit}{alike}", {**cure, **size_cure})


def _cure_of_size(size_lwh: Array, scale: float, length_m: float | None) -> tuple[dict[str, str | float], str]:
    """Options that scale a car of this size, in its own unit, to the length of cars, and its unit in words."""
    low, high = _LENGTHS_M
    if low <= (size_lwh[0] * scale if length_m is None else length_m) <= high:
        return {}, ""
    if length_m is not None:
        return {"length_m": _USUAL_LENGTH_M}, f", but of {length_m:.4g} m"
    unit = _unit_of(size_lwh)
    if unit is not None:
        return {"scale": UNITS_M[unit]}, f" in {unit}"
    return {"length_m": _USUAL_LENGTH_M}, f" of the length {size_lwh[0]:.4g} in no usual unit"


def _unit_of(size_lwh: Array) -> str | None:
    """The unit in which these sizes are length, width and height of a car, or None."""
    bounds = np.array([_LENGTHS_M, _WIDTHS_M, _HEIGHTS_M])
    fitting = [
        name
        for name, metres in UNITS_M.items()
        if ((bounds[:, 0] <= metres * size_lwh) & (metres * size_lwh <= bounds[:, 1])).all()
    ]
    return min(fitting, key=lambda name: abs(math.log(size_lwh[0] * UNITS_M[name] / _USUAL_LENGTH_M)), default=None)


def _no_car(outlines: Outlines, measured: str) -> UnlikelyMeshError:
    """The error that says why a shape looks like a car in no turn."""
    if is_half_a_car(outlines):
        return UnlikelyMeshError(f"{measured}: it looks like half a car, cut along its middle; give all of it", {})
    overlaps = [looks.overlap for looks in all_looks(outlines) if looks.has_the_sizes_of_a_car]
    why = "no car has its proportions"
    if overlaps:
        why = f"left and right overlap by {max(overlaps):.2f} at most, those of cars by {_LEAST_OVERLAP} or more"
    found = f"{measured}: it looks like a car in no turn, for {why}; leave out what is no part of the car"
    return UnlikelyMeshError(found, {})


def posture(wanted: Looks, forward: str, up: str) -> str:
    """The posture, in words, of a car with the axes of `wanted` where other axes are taken for its front and up."""
    if up[1] == wanted.up[1]:
        if up[0] != wanted.up[0]:
            return "upside down"
        return "driving backwards" if forward[1] == wanted.forward[1] else "turned by 90 degrees about the vertical"
    return "standing on its front or rear" if up[1] == wanted.forward[1] else "lying on its side"


def _closed(mask: Mask, axis: int) -> Mask:
    """All cells between the first and the last filled one along an axis."""
    after = np.maximum.accumulate(mask, axis)
    before = np.flip(np.maximum.accumulate(np.flip(mask, axis), axis), axis)
    return np.asarray(after & before)


def _overlap_with_mirror_image(mask: Mask) -> float:
    """Intersection over union of a mask and its mirror image at the best shift by a few rows.

    A bar at one side of a car shifts its mirror image.
    """
    best, room = 0.0, max(len(mask) // 8, 1)
    for shift in range(-room, room + 1):
        image = np.zeros_like(mask)
        rows = np.arange(len(mask))
        kept = (rows + shift >= 0) & (rows + shift < len(mask))
        image[rows[kept] + shift] = mask[::-1][rows[kept]]
        best = max(best, float((mask & image).sum() / max((mask | image).sum(), 1)))
    return best


def _gap_below(front: Mask) -> float:
    """How much more of the middle of a view from the front is open at the ground than at the roof, -1 .. 1."""
    width, height = front.shape
    middle, band = front[3 * width // 8 : width - 3 * width // 8], max(height // 12, 1)
    below, above = (float(part.any(axis=1).mean()) for part in (middle[:, :band], middle[:, -band:]))
    return above - below


def _has_room_above(profile: Mask) -> bool:
    """Whether more is open above bonnet and boot than under the floor, in a view from the side."""
    below_top = np.maximum.accumulate(profile[:, ::-1], axis=1).sum()
    above_bottom = np.maximum.accumulate(profile, axis=1).sum()
    return bool(below_top <= above_bottom)


def _third_axis(forward: str, up: str) -> str:
    return next(axis for axis in "xyz" if axis not in forward + up)


def _roof_centre(profile: Mask) -> float:
    """Position along the length of the centre of the part above half the height, 0 .. 1."""
    filled = profile[:, profile.shape[1] // 2 :].sum(axis=1)
    return float((filled * (np.arange(len(filled)) + 0.5)).sum() / max(filled.sum(), 1) / len(filled))
