"""Where a ray comes closest to a shape: the least signed distance along it.

Between the faces of a grid's cells the signed distance along a ray is a polynomial of degree 3, so its minimum is found
exactly, cell by cell. It lies inside a cell, where the slope along the ray vanishes, or on a face, where the slope
changes sign by a jump. There the closest point slides along the face as the car moves, which is what makes the
derivative of the least distance that of the point (the envelope theorem) with the gradient that `RayMinimum.face_obj`
corrects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.tensors import length
from directshape_torch.shape.sdf_grid import GridField, corner_values, halves, moved, scaled

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
# Beside a slope of a thousandth, this one below a fraction bar is beyond all grids.
_TINY = 1e-20


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
    # From here on a ray is seen the way the distance falls from where it begins, by how far it has come. There is no
    # choice between two values by a condition in what follows: on a processor one costs as much as ten sums.
    sign = -torch.copysign(torch.ones_like(depth), along.first)
    limit = torch.maximum(sign * (far - depth), sign * (near - depth))
    along = _AlongRay(-along.first.abs(), along.second, along.third * sign)
    heading = step * sign
    into_next = heading.sign()
    to_face, per_cell = (0.5 + 0.5 * into_next - place) / heading, into_next / heading
    face = crossed = torch.zeros_like(heading)  # the last one, 1 at its axis; crossed now
    come, running = torch.zeros_like(depth), limit > 0
    is_kink = torch.zeros_like(running)
    for number in range(max_cells):
        if number:
            moves = crossed * into_next
            # Rounding may lead a ray that ends at the border beyond it, of which nothing is used.
            node = (node + field.steps(moves)).clamp(0, len(field.values) - 1 - field.steps_to_last_corner)
            place = place - moves
            to_face = torch.addcmul(to_face, crossed, per_cell)
            # Who has arrived is where the slope vanishes, or grows: he stays.
            along = _derivatives_along(field, node, torch.addcmul(place, come, heading), heading)
        # Where it grows from the face on through which the ray came, the minimum is a kink on that face.
        is_kink = is_kink | ((along.first > 0) & running)
        root, exit_at = come + _first_root(along), to_face.amin(0)
        reach = torch.minimum(exit_at, limit)
        running = running & (root > reach) & (limit > exit_at)
        come = torch.minimum(root, reach)
        goes_on = running.to(depth.dtype)
        crossed = ((exit_at - to_face).sign() + 1) * goes_on
        face = torch.addcmul(crossed, face, 1 - goes_on)
    return RayMinimum(torch.addcmul(depth, sign, come), face * (is_kink | running).to(depth.dtype))


def curvature_in_grids(
    field: GridField, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor
) -> Tensor:
    """Second derivative (M, R) of the signed distance by the depth, inside the cells at depths (M, R)."""
    step, node, place = _cells_along(field, owner, centre_obj, direction_obj, depth)
    return 2 * _derivatives_along(field, node, place, step).second


def _cells_along(
    field: GridField, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells per metre of depth (3, M, R), lower node (M, R) of the cell at a depth, and the place (3, M, R) in it."""
    step = direction_obj * (1 / field.spacing_m)
    step = torch.copysign(step.abs().clamp_min(_NO_STEP), step)
    position = torch.addcmul(field.positions(centre_obj), depth, step)
    lower = (position + _ON_FACE).floor().clamp_min(0).minimum(field.last_nodes(position) - 1)
    return step, field.nodes_of(field.lower_nodes(lower), owner[:, None]), position - lower


def _derivatives_along(field: GridField, node: Tensor, place: Tensor, step: Tensor) -> _AlongRay:
    """Coefficients of the polynomial along a ray in the cell with lower node (M, R), at a place (3, M, R) in it."""
    (ux, uy, uz), (dx, dy, dz) = place, step
    # Interpolated along z, then y, then x: each time a polynomial of the distance gains a degree.
    lower, rise = halves(corner_values(field, node))
    (a0, rise_0), (a1, rise_1) = halves(moved(lower, uz, rise)), halves(scaled(dz, rise))
    b1 = moved(moved(a1, uy, rise_1), dy, rise_0)
    (_, rise_0), (b1, rise_1), (b2, rise_2) = map(halves, (moved(a0, uy, rise_0), b1, scaled(dy, rise_1)))
    first = moved(moved(b1, ux, rise_1), dx, rise_0)
    second = moved(moved(b2, ux, rise_2), dx, rise_1)
    return _AlongRay(first[0], second[0], scaled(dx, rise_2)[0])


def _first_root(along: _AlongRay) -> Tensor:
    """Distance (M, R) downhill to where the slope vanishes: 0 where it has done so already, huge where it never does.

    With `c + 2 b s + 3 a s^2` the slope at a distance s downhill (c < 0), its first root is `-c / (b + sqrt(b^2 -
    3 a c))`, without cancellation.
    """
    first, second, third = along
    discriminant = torch.addcmul(second * second, third, first, value=-3)
    # The root of a negative number takes many times as long as that of another.
    below = (second + discriminant.clamp_min(0).sqrt()).clamp_min(0) * discriminant.sign().clamp_min(0)
    return (-first).clamp_min(0) / (below + _TINY)


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
