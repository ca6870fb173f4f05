"""This module sums weighted products of Jacobians over the rows of a block, as `terms.term.part_of` does."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Doubles, Grid, Index, Point, Real, Reals, Sums
from directshape_torch.kernels.grid import code_derivative_in, scaled
from directshape_torch.kernels.jit import step


@step
def write_jacobian(
    grid: Grid, node: Index, in_cell: Point, point: Point, gradient: Point, scale: Real, J: Reals
) -> None:
    """Write `scale J_sdf_state` (`terms.silhouette.sdf_state_jacobian`), of pose and code."""
    (x, y, z), (u, v, w) = point, scaled(gradient, scale)
    J[0], J[1], J[2] = u, v, w
    J[3], J[4], J[5] = y * w - z * v, z * u - x * w, x * v - y * u
    code_derivative_in(grid, np.uint64(node), in_cell, scale, J[6:])


@step
def write_weighted(J: Reals, hessian_weight: Real, gradient_weight: Real, weighted: Reals) -> None:
    """Write the columns with which the Jacobian of a row is multiplied, of the matrix and, last, of the gradient."""
    for k in range(len(J)):
        weighted[k] = hessian_weight * J[k]
    weighted[len(J)] = gradient_weight


@step
def write_products(weighted: Reals, J: Reals, block: Index, out: Sums) -> None:
    """Write matrix and gradient of a block, from its rows (R, C + 1) and (R, C)."""
    products, into = np.dot(weighted.T, J), out.products[block]
    write_square(products, into, out.first)
    for k in range(J.shape[1]):
        into[len(into) - 1, out.first + k] = products[J.shape[1], k]


@step
def write_square(matrix: Reals, into: Doubles, first: int) -> None:
    """Write a matrix (C or more, C) to the columns from `first` on, and to the rows of the same numbers."""
    for i in range(matrix.shape[1]):
        for k in range(matrix.shape[1]):
            into[first + i, first + k] = matrix[i, k]
