"""This module fits the rectangle of a car, seen from above, to stereo points of many instances at once.

A point on a car lies on one of the two sides that the camera sees. The outer columns of an instance's mask show the
outline of the car. Length and width stay near those of the mean car. All this together gives place, axis and size of
the car; which end is the front it does not tell. All instances, headings and first depths are solved in one batch by
iterated weighted least squares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from directshape_torch.kernels.arguments import RectangleRules, SeenFromAbove
from directshape_torch.kernels.choice import array, takes_loops

MEAN_HWL = (1.52, 1.63, 3.88)
"""These are the height, width and length of the mean car of KITTI's labels, metres."""

# The fit begins at each of these headings modulo half a turn, and at each of these depths behind the points, metres.
_NUM_HEADINGS = 12
_SETBACKS_M = (0.3, 1.3)
# All of these take this many steps; then those of lowest cost take as many again.
_NUM_ITERATIONS, _NUM_KEPT = 8, 4
# A point farther than this from the nearest side counts less and less; beside the outline this is the limit too.
_POINT_SCALE_M, _OUTLINE_SCALE_M = 0.4, 0.5
# The outline of a car has rounded corners. These are corners of an octagon inside the rectangle, in lengths and widths.
_OCTAGON = ((0.5, 0.34), (0.43, 0.5))
_OUTLINE_WEIGHT = 0.3
# Weights and standard deviations of length and width about the mean car's, metres.
_SIZE_WEIGHT, _SIZE_SIGMA_M = 0.002, (0.4, 0.1)
_LARGEST_STEP = (0.5, 0.5, 0.2, 0.3, 0.1)
_DAMPING = 1e-4
# A corner has at least this depth, metres.
_LEAST_DEPTH_M = 0.5
_CORNERS = [(i * a, k * b) for a, b in _OCTAGON for i in (1, -1) for k in (1, -1)]
_RULES = RectangleRules(
    _NUM_ITERATIONS,
    _DAMPING,
    np.array(_LARGEST_STEP),
    (MEAN_HWL[2], MEAN_HWL[1]),
    _SIZE_SIGMA_M,
    _SIZE_WEIGHT,
    _POINT_SCALE_M,
    _OUTLINE_SCALE_M,
    _OUTLINE_WEIGHT,
    np.array(_CORNERS),
    _LEAST_DEPTH_M,
)


class InstancePoints(NamedTuple):
    """`InstancePoints` are what the fit knows of M instances; P is the most points of any of them."""

    xz: Tensor  # (M, P, 2) points from above, x right and z forward, metres
    weight: Tensor  # (M, P) weights, which sum up to 1 for each instance; 0 for places without a point
    middle: Tensor  # (M, 2) median of the points
    outline: Tensor  # (M, 2) x / z of the first and the last column of the mask
    is_end_seen: Tensor  # (M, 2) bool, false where the border of the image or a nearer object cuts the mask off


def fit_rectangles(seen: InstancePoints) -> tuple[Tensor, Tensor]:
    """Fit rectangles from all headings and first depths; NaN where an instance has no points.

    Returns:
        The C rectangles of lowest cost of each instance (M, C, 5), in no order, and some of them may be the same: x and
        z of the centre, metres, heading `rotation_y`, radians, length and width, metres. Their mean robust costs
        (M, C), square metres.
    """
    place, cost = _improved(_starts(seen), seen)
    _, kept = cost.nan_to_num(nan=math.inf, posinf=math.inf).topk(_NUM_KEPT, dim=1, largest=False)
    return _improved(place.gather(1, kept[..., None].expand(-1, -1, place.shape[-1])), seen)


def distance_outside(place: Tensor, xz: Tensor) -> Tensor:
    """Distances (M, P) of points (M, P, 2) to rectangles (M, 5), metres; 0 within them and NaN for points of NaN."""
    c, s = torch.cos(place[:, 2:3]), torch.sin(place[:, 2:3])
    dx, dz = (xz - place[:, None, :2]).unbind(-1)
    beyond = (torch.stack([c * dx - s * dz, s * dx + c * dz], dim=-1).abs() - 0.5 * place[:, None, 3:]).clamp_min(0)
    return torch.hypot(beyond[..., 0], beyond[..., 1])


def outline_of(place: Tensor) -> Tensor:
    """x / z (..., 2) of the first and the last column of rectangles (..., 5) in the image."""
    return _outer_corners(place)[0]


def _improved(place: Tensor, seen: InstancePoints) -> tuple[Tensor, Tensor]:
    """The rectangles after some steps from places (M, C, 5), and their costs (M, C)."""
    if takes_loops(place, seen.xz):
        return _improved_natively(place, seen)
    seen = InstancePoints(*(each[:, None] for each in seen))
    limit = place.new_tensor(_LARGEST_STEP)
    damping = _DAMPING * torch.eye(len(limit), dtype=place.dtype, device=place.device)
    for _ in range(_NUM_ITERATIONS):
        residual, J, weight, _ = _rows(place, seen)
        weighted = J * weight[..., None]
        step = -torch.linalg.solve_ex(weighted.mT @ J + damping, weighted.mT @ residual[..., None])[0][..., 0]
        place = place + step.maximum(-limit).minimum(limit)
    return place, _rows(place, seen)[3]


def _improved_natively(place: Tensor, seen: InstancePoints) -> tuple[Tensor, Tensor]:
    from directshape_torch.kernels.rectangles import improve  # Numba may be missing.

    places, costs = array(place.double()), array(place.new_empty(place.shape[:2], dtype=torch.float64))
    improve(_RULES, SeenFromAbove(*map(array, seen)), places, costs)
    return torch.from_numpy(places).to(place), torch.from_numpy(costs).to(place)


def _starts(seen: InstancePoints) -> Tensor:
    """First places (M, C, 5): a mean car with every heading at every depth behind the middle of the points."""
    turns = torch.arange(_NUM_HEADINGS, dtype=seen.xz.dtype, device=seen.xz.device) * (math.pi / _NUM_HEADINGS)
    back = seen.xz.new_tensor(_SETBACKS_M)
    ray = seen.middle / seen.middle.norm(dim=-1, keepdim=True)
    centre = seen.middle[:, None] + back[:, None] * ray[:, None]  # (M, S, 2)
    shape = len(centre), len(back), len(turns)
    size = seen.xz.new_tensor((MEAN_HWL[2], MEAN_HWL[1]))
    parts = centre[:, :, None].expand(*shape, 2), turns[:, None].expand(*shape, 1), size.expand(*shape, 2)
    return torch.cat(parts, dim=-1).flatten(1, 2)


def _rows(place: Tensor, seen: InstancePoints) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals (M, C, R), their Jacobian (M, C, R, 5), robust weights (M, C, R) and the robust cost (M, C)."""
    parts = _point_rows(place, seen), _outline_rows(place, seen), _size_rows(place)
    residual, J, weight = (torch.cat([part[k] for part in parts], dim=2) for k in range(3))
    return residual, J, weight, parts[0][3] + parts[1][3] + parts[2][3]


def _point_rows(place: Tensor, seen: InstancePoints) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows of the distances of points to the nearest side that the camera sees, across that side and along it."""
    x, z, heading = (each[..., None] for each in place[..., :3].unbind(-1))
    half = 0.5 * place[..., None, 3:]
    c, s = torch.cos(heading), torch.sin(heading)
    dx, dz = seen.xz[..., 0] - x, seen.xz[..., 1] - z
    u, v = c * dx - s * dz, s * dx + c * dz
    at = torch.stack([u, v], dim=-1)  # (M, C, P, 2) along the car and across it
    camera = torch.stack([s * z - c * x, -s * x - c * z], dim=-1)  # (M, C, 1, 2)
    to_side = at - camera.sign() * half
    beyond, sense = (at.abs() - half).clamp_min(0), at.sign()
    # A camera inside of the rectangle sees no side, which leaves an infinite distance.
    distance = torch.where(camera.abs() > half, torch.hypot(to_side, beyond.flip(-1)), torch.inf)
    least, nearest = distance.min(dim=-1, keepdim=True)
    order = torch.cat([nearest, 1 - nearest], dim=-1)
    rows = torch.cat([to_side.gather(-1, nearest), (sense * beyond).gather(-1, 1 - nearest)], dim=-1)
    end = torch.cat([camera.sign().expand_as(at).gather(-1, nearest), sense.gather(-1, 1 - nearest)], dim=-1)
    is_length = order == 0
    first, second = (
        torch.where(is_length, -c[..., None], -s[..., None]),
        torch.where(is_length, s[..., None], -c[..., None]),
    )
    turned = torch.where(is_length, -v[..., None], u[..., None])
    J = torch.stack([first, second, turned, -0.5 * end * is_length, -0.5 * end * ~is_length], dim=-1)
    J = torch.where((rows != 0)[..., None], J, 0.0)
    share = (least[..., 0] / _POINT_SCALE_M).square()
    known = seen.weight > 0
    cost = torch.where(known, seen.weight * _POINT_SCALE_M**2 * share / (1 + share), 0.0).sum(-1)
    weight = torch.where(known, seen.weight / (1 + share).square(), 0.0)[..., None].expand_as(rows)
    return rows.flatten(2), J.flatten(2, 3), weight.flatten(2), cost


def _outline_rows(place: Tensor, seen: InstancePoints) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows of the distances, metres, by which the outer corners miss the first and last columns of the mask."""
    column, depth, dx, dz, along, across = _outer_corners(place)
    c, s = torch.cos(place[..., 2:3]), torch.sin(place[..., 2:3])
    by = (1.0, -column, dz + column * dx, (c + column * s) * along, (s - column * c) * across)
    # A difference of columns counts in metres at the depth of the points.
    scale = seen.middle[..., 1:]
    J = torch.stack([scale * each / depth for each in by], dim=-1)
    off = column - seen.outline
    # Where no end is seen, the car may go on beyond the mask, but does not end within it.
    counts = seen.is_end_seen | (off * off.new_tensor((1.0, -1.0)) > 0)
    off = torch.where(counts, scale * off, 0.0)
    share = (off / _OUTLINE_SCALE_M).square()
    cost = _OUTLINE_WEIGHT * _OUTLINE_SCALE_M**2 * (share / (1 + share)).sum(-1)
    weight = torch.where(counts, _OUTLINE_WEIGHT / (1 + share).square(), 0.0)
    return off, J, weight, cost


def _outer_corners(place: Tensor) -> tuple[Tensor, ...]:
    """The first and the last corner (..., 2) in the image of rectangles (..., 5).

    Of each are returned x / z, z, x and z from the centre, metres, and its place along and across the car, in lengths
    and widths.
    """
    ends = place.new_tensor(_CORNERS)
    x, z, heading = (each[..., None] for each in place[..., :3].unbind(-1))
    c, s = torch.cos(heading), torch.sin(heading)
    along, across = (ends * place[..., None, 3:]).unbind(-1)
    dx, dz = c * along + s * across, c * across - s * along
    depth = (z + dz).clamp_min(_LEAST_DEPTH_M)
    column = (x + dx) / depth
    outer = torch.stack([column.argmin(-1), column.argmax(-1)], dim=-1)
    return *(each.gather(-1, outer) for each in (column, depth, dx, dz)), *(each[outer] for each in ends.unbind(-1))


def _size_rows(place: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows of length and width against the mean car's, in their standard deviations."""
    sigma = place.new_tensor(_SIZE_SIGMA_M)
    off = (place[..., 3:] - place.new_tensor((MEAN_HWL[2], MEAN_HWL[1]))) / sigma
    J = torch.nn.functional.pad(torch.diag(1 / sigma), (3, 0)).expand(*off.shape, 5)
    return off, J, torch.full_like(off, _SIZE_WEIGHT), _SIZE_WEIGHT * off.square().sum(-1)
