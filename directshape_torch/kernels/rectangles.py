"""This module fits the rectangles of `start.rectangle_fit`, one after the other and in double precision."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from directshape_torch.kernels.arguments import Doubles, Index, RectangleRules, SeenFromAbove
from directshape_torch.kernels.jit import SOURCES, loop, step


class RectangleSums(NamedTuple):
    """`RectangleSums` are the sums over all rows of a rectangle, with room for one row of the Jacobian."""

    J: Doubles  # (5,)
    matrix: Doubles  # (5, 5), of which the lower half is written
    gradient: Doubles  # (5,)


@loop
def improve(
    rules: RectangleRules, seen: SeenFromAbove, places: Doubles, costs: Doubles, _sources: int = SOURCES
) -> None:
    """Move rectangles (M, C, 5) by some steps, and write their costs (M, C)."""
    sums, change = RectangleSums(np.empty(5), np.empty((5, 5)), np.empty(5)), np.empty(5)
    for instance in range(np.uint64(len(places))):
        for number in range(np.uint64(places.shape[1])):
            place = places[instance, number]
            for _ in range(rules.num_iterations):
                add_rows(rules, seen, instance, place, sums)
                solve_in_place(sums.matrix, rules.damping, sums.gradient, change)
                for k in range(5):
                    # Comparisons with NaN are false, so NaN stays.
                    limit = rules.largest_step[k]
                    step_k = limit if change[k] > limit else change[k]
                    place[k] += -limit if step_k < -limit else step_k
            costs[instance, number] = add_rows(rules, seen, instance, place, sums)


@step
def add_rows(rules: RectangleRules, seen: SeenFromAbove, instance: Index, place: Doubles, sums: RectangleSums) -> float:
    """Write the sums of all rows of a rectangle, and return its cost."""
    sums.gradient[:] = 0.0
    sums.matrix[:] = 0.0
    cost = add_points(rules, seen, instance, place, sums)
    cost += add_outline(rules, seen, instance, place, sums)
    for axis in range(2):
        off = (place[3 + axis] - rules.mean_size[axis]) / rules.size_sigma[axis]
        sums.J[:] = 0.0
        sums.J[3 + axis] = 1.0 / rules.size_sigma[axis]
        add(rules.size_weight, off, sums)
        cost += rules.size_weight * off * off
    return cost


@step
def add(weight: float, residual: float, sums: RectangleSums) -> None:
    J, matrix, gradient = sums.J, sums.matrix, sums.gradient
    for i in range(5):
        gradient[i] += weight * residual * J[i]
        for k in range(i + 1):
            matrix[i, k] += weight * J[i] * J[k]


@step
def solve_in_place(matrix: Doubles, damping: float, gradient: Doubles, change: Doubles) -> None:
    """Write the step to the minimum; the lower half of the matrix becomes its damped Cholesky factor."""
    for k in range(5):
        matrix[k, k] += damping
        for i in range(k, 5):
            for j in range(k):
                matrix[i, k] -= matrix[i, j] * matrix[k, j]
            matrix[i, k] = np.sqrt(matrix[k, k]) if i == k else matrix[i, k] / matrix[k, k]
    for i in range(5):
        change[i] = -gradient[i]
        for j in range(i):
            change[i] -= matrix[i, j] * change[j]
        change[i] /= matrix[i, i]
    for i in range(4, -1, -1):
        for j in range(i + 1, 5):
            change[i] -= matrix[j, i] * change[j]
        change[i] /= matrix[i, i]


@step
def add_points(
    rules: RectangleRules, seen: SeenFromAbove, instance: Index, place: Doubles, sums: RectangleSums
) -> float:
    """Add the rows of `_point_rows`, and return their cost."""
    x, z, c, s, J = place[0], place[1], np.cos(place[2]), np.sin(place[2]), sums.J
    half, camera = (0.5 * place[3], 0.5 * place[4]), (s * z - c * x, -s * x - c * z)
    side = (np.sign(camera[0]), np.sign(camera[1]))
    is_seen = (abs(camera[0]) > half[0], abs(camera[1]) > half[1])
    cost = 0.0
    for number in range(np.uint64(seen.weight.shape[1])):
        weight = np.float64(seen.weight[instance, number])
        if not weight > 0.0:
            continue
        dx, dz = seen.xz[instance, number, 0] - x, seen.xz[instance, number, 1] - z
        at = (c * dx - s * dz, s * dx + c * dz)
        to_side = (at[0] - side[0] * half[0], at[1] - side[1] * half[1])
        beyond = (max(abs(at[0]) - half[0], 0.0), max(abs(at[1]) - half[1], 0.0))
        # A camera inside of the rectangle sees no side, which leaves an infinite distance.
        to_length = to_side[0] * to_side[0] + beyond[1] * beyond[1] if is_seen[0] else np.inf
        to_width = to_side[1] * to_side[1] + beyond[0] * beyond[0] if is_seen[1] else np.inf
        least = min(to_length, to_width)  # squared
        if not least < np.inf:
            cost = np.inf
            continue
        share = least / (rules.point_scale * rules.point_scale)
        cost += weight * least / (1.0 + share)
        weight /= (1.0 + share) * (1.0 + share)
        nearest = 0 if to_length <= to_width else 1
        for axis in range(2):
            sense = np.sign(at[axis])
            residual = to_side[axis] if axis == nearest else sense * beyond[axis]
            if residual == 0.0:
                continue
            J[0], J[1], J[2] = (-c, s, -at[1]) if axis == 0 else (-s, -c, at[0])
            J[3], J[4] = 0.0, 0.0
            J[3 + axis] = -0.5 * (side[axis] if axis == nearest else sense)
            add(weight, residual, sums)
    return cost


@step
def add_outline(
    rules: RectangleRules, seen: SeenFromAbove, instance: Index, place: Doubles, sums: RectangleSums
) -> float:
    """Add the rows of `_outline_rows`, and return their cost."""
    c, s, scale, J = np.cos(place[2]), np.sin(place[2]), np.float64(seen.middle[instance, 1]), sums.J
    cost = 0.0
    for end in range(np.uint64(2)):
        # The first corner in the image, or the last one with the sign turned.
        sign, outer = 1.0 if end == 0 else -1.0, np.inf
        column = depth = dx = dz = a = b = np.nan
        for number in range(np.uint64(len(rules.corners))):
            a_n, b_n = rules.corners[number, 0], rules.corners[number, 1]
            along, across = a_n * place[3], b_n * place[4]
            dx_n, dz_n = c * along + s * across, c * across - s * along
            depth_n = max(place[1] + dz_n, rules.least_depth)
            column_n = (place[0] + dx_n) / depth_n
            if sign * column_n < outer:
                outer, column, depth, dx, dz, a, b = sign * column_n, column_n, depth_n, dx_n, dz_n, a_n, b_n
        off = column - seen.outline[instance, end]
        # Where no end is seen, the car may go on beyond the mask, but does not end within it.
        if seen.is_end_seen[instance, end] or off * sign > 0.0:
            off *= scale
            share = (off / rules.outline_scale) ** 2
            cost += rules.outline_weight * off * off / (1.0 + share)
            per = scale / depth
            J[0], J[1], J[2] = per, -per * column, per * (dz + column * dx)
            J[3], J[4] = per * (c + column * s) * a, per * (s - column * c) * b
            add(rules.outline_weight / (1.0 + share) ** 2, off, sums)
    return cost
