"""Where a ray comes closest to a shape: the least signed distance along it.

Between the faces of a grid's cells the signed distance along a ray is a polynomial of degree 3, so its minimum is found
exactly, cell by cell. It lies inside a cell, where the slope along the ray vanishes, or on a face, where the slope
changes sign by a jump. There the closest point slides along the face as the car moves, which is what makes the
derivative of the least distance that of the point (the envelope theorem) with the gradient that `RayMinimum.face_obj`
corrects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.tensors import length
from directshape_torch.shape.sdf_grid import GridField, corner_values, differences, moved

# Distance of the three samples that begin a search where nothing but values is known.
_FIRST_SAMPLES_M = 0.06
# Each round is so many times as fine as the one before.
_FINER = 4.0
_ROUNDS = 3
# A vertex of a parabola further away, in distances of its samples, is a guess.
_MAX_SAMPLE_DISTANCES = 1.5
# A start so near to the face in front of it, in cells, begins behind it: where a search has ended on a face, rounding
# does not choose the cell in which the next one begins.
_ON_FACE = 1e-4
# Second difference of three samples below which it is rounding.
_LEAST_CURVATURE_M = 1e-6
_NO_STEP = 1e-12


class RayMinimum(NamedTuple):
    """The least signed distance along rays (M, R), near where it was looked for."""

    depth: Tensor  # (M, R) metres
    face_obj: Tensor  # (3, M, R) normal of the face on which the minimum is a kink; zero where it is smooth


class _AlongRay(NamedTuple):
    """Coefficients (M, R) of the derivative by the distance, `first + 2 second t + 3 third t^2`, inside a cell."""

    first: Tensor
    second: Tensor
    third: Tensor


def minimum_in_grids(
    field: GridField,
    owner: Tensor,  # (M,)
    centre_obj: Tensor,  # (3, M, 1) metres
    direction_obj: Tensor,  # (3, M, R) per metre of depth
    depth: Tensor,  # (M, R) to begin at
    near: Tensor,  # (M, R) between these depths, inside the grid
    far: Tensor,  # (M, R)
    max_cells: int,
) -> RayMinimum:
    """Downhill from cell to cell until the distance grows again, `max_cells` at most.

    A minimum at `near` or `far` counts as smooth here: the caller knows what lies there. What is not found by then
    waits on the face that it came to, and goes on from there when the ray is tracked next. A ray whose `near` is its
    `far` stays there.
    """
    step, node, place = _cells_along(field, owner, centre_obj, direction_obj, depth)
    along = _derivatives_along(field, node, place, step)
    # From here on a ray is seen the way the distance falls from where it begins, by how far it has come.
    backwards = along.first > 0
    sign = torch.where(backwards, -1.0, 1.0)
    limit = torch.where(backwards, depth - near, far - depth)
    along = _AlongRay(-along.first.abs(), along.second, along.third * sign)
    heading = [x * sign for x in step]
    upwards = [torch.where(x > 0, 1.0, 0.0) for x in heading]
    to_face = [(up - at) / x for up, at, x in zip(upwards, place, heading, strict=True)]
    per_cell, into_next = [1 / x.abs() for x in heading], [2 * up - 1 for up in upwards]
    face = crossed = [torch.zeros_like(depth)] * 3  # the last one, 1 at its axis; crossed now
    come, running = torch.zeros_like(depth), limit > 0
    is_kink = torch.zeros_like(running)
    last_node = len(field.values) - 1 - field.corners[-1]
    for number in range(max_cells):
        if number:
            moves = [x * into for x, into in zip(crossed, into_next, strict=True)]
            # Rounding may lead a ray that ends at the border beyond it, of which nothing is used.
            node = (node + field.node_at(moves)).clamp(0, last_node)
            place = [at - move for at, move in zip(place, moves, strict=True)]
            to_face = [torch.addcmul(*x) for x in zip(to_face, crossed, per_cell, strict=True)]
            now = [torch.addcmul(at, come, x) for at, x in zip(place, heading, strict=True)]
            along = _derivatives_along(field, node, now, heading)
        # Where it grows from the face on through which the ray came, the minimum is a kink on that face.
        grows = along.first > 0
        root = come + torch.where(grows, 0.0, _first_root(along))
        exit_at = torch.minimum(torch.minimum(to_face[0], to_face[1]), to_face[2])
        reach = torch.minimum(exit_at, limit)
        is_inside = (root >= come) & (root <= reach)
        come = torch.where(is_inside, root, reach)
        is_kink = is_kink | (grows & running)
        running = running & ~is_inside & (limit > exit_at)
        # Who has arrived stays.
        limit = torch.where(running, limit, come)
        crossed = [((x == exit_at) & running).to(depth.dtype) for x in to_face]
        face = [torch.where(running, x, before) for x, before in zip(crossed, face, strict=True)]
    has_face = is_kink | running
    return RayMinimum(torch.addcmul(depth, sign, come), torch.stack([torch.where(has_face, x, 0.0) for x in face]))


def curvature_in_grids(
    field: GridField, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor
) -> Tensor:
    """Second derivative (M, R) of the signed distance by the depth, inside the cells at depths (M, R)."""
    step, node, place = _cells_along(field, owner, centre_obj, direction_obj, depth)
    return 2 * _derivatives_along(field, node, place, step).second


def _cells_along(
    field: GridField, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor
) -> tuple[list[Tensor], Tensor, list[Tensor]]:
    """Cells per metre of depth, lower node (M, R) of the cell at a depth, and the place in it: along three axes."""
    per_metre = 1 / field.spacing_m
    step, cell, place = [], [], []
    for centre, direction, origin, last in zip(centre_obj, direction_obj, field.origin, field.last_node, strict=True):
        along = direction * per_metre
        along = torch.where(along.abs() < _NO_STEP, _NO_STEP, along)
        position = torch.addcmul((centre - origin) * per_metre, depth, along)
        # A comparison with NaN is false: a NaN ray has a cell too.
        lower = torch.where(position >= 0, (position + _ON_FACE).floor(), 0.0).clamp_max(last - 1)
        step.append(along)
        cell.append(lower)
        place.append(position - lower)
    return step, field.node_at(cell) + owner[:, None] * field.num_nodes, place


def _derivatives_along(field: GridField, node: Tensor, place: Sequence[Tensor], step: Sequence[Tensor]) -> _AlongRay:
    """Of the polynomial that belongs to a cell with lower node (M, R), at a place in it, along three axes each."""
    (ux, uy, uz), (dx, dy, dz) = place, step
    corners = corner_values(field, node)
    # Interpolated along z, then y, then x: each time a polynomial of the distance gains a degree.
    lower, rises = corners[0::2], differences(corners)
    a0, a1 = moved(lower, uz, rises), [dz * rise for rise in rises]
    r0, r1 = differences(a0), differences(a1)
    b0, b2 = moved(a0[0::2], uy, r0), [dy * r for r in r1]
    b1 = moved(moved(a1[0::2], uy, r1), dy, r0)
    rise_0, rise_1, rise_2 = (upper - lower for lower, upper in (b0, b1, b2))
    first = torch.addcmul(torch.addcmul(b1[0], ux, rise_1), dx, rise_0)
    second = torch.addcmul(torch.addcmul(b2[0], ux, rise_2), dx, rise_1)
    return _AlongRay(first, second, dx * rise_2)


def _first_root(along: _AlongRay) -> Tensor:
    """Distance (M, R) downhill to where the slope vanishes; NaN or negative where it does not.

    With `c + 2 b s + 3 a s^2` the slope at a distance s downhill (c < 0), its first root is `-c / (b + sqrt(b^2 -
    3 a c))`, without cancellation.
    """
    first, second, third = along
    discriminant = torch.addcmul(second * second, third, first, value=-3)
    return -first / (second + discriminant.sqrt())


def minimum_by_values(
    value_at: Callable[[Tensor], Tensor],  # signed distance (..., M, R) at depths (..., M, R)
    direction_obj: Tensor,  # (3, M, R)
    depth: Tensor,  # (M, R)
    near: Tensor,  # (M, R)
    far: Tensor,  # (M, R)
) -> RayMinimum:
    """For shapes of which nothing but smoothness is known: vertices of ever narrower parabolas."""
    step = _FIRST_SAMPLES_M / length(direction_obj, dim=0)
    for _ in range(_ROUNDS):
        before, here, after = value_at(torch.stack([depth - step, depth, depth + step]))
        second, slope = before - 2 * here + after, 0.5 * (after - before)
        # Where the field does not curve upwards the slope tells the side, and no more.
        vertex = -slope / second.clamp_min(_LEAST_CURVATURE_M)
        depth = depth + vertex.clamp(-_MAX_SAMPLE_DISTANCES, _MAX_SAMPLE_DISTANCES) * step
        depth = torch.minimum(torch.maximum(depth, near), far)
        step = step / _FINER
    return RayMinimum(depth, torch.zeros_like(direction_obj))


def curvature_by_values(value_at: Callable[[Tensor], Tensor], direction_obj: Tensor, depth: Tensor) -> Tensor:
    """Second derivative (M, R) of the signed distance by the depth, from three values."""
    step = _FIRST_SAMPLES_M / _FINER**2 / length(direction_obj, dim=0)
    before, here, after = value_at(torch.stack([depth - step, depth, depth + step]))
    curvature: Tensor = (before - 2 * here + after) / (step * step)
    return curvature
