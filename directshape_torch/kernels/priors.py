"""This module evaluates the priors of `terms.priors`, car by car and in double precision."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Columns, Doubles, Index, PriorArrays, Reals, States, Sums, Turn
from directshape_torch.kernels.jit import SOURCES, loop, step


@loop
def priors(terms: PriorArrays, columns: Columns, state: States, turn: Turn, out: Sums, _sources: int = SOURCES) -> None:
    """Write the sums of all priors of the cars whose turn it is; each car has one block."""
    num_codes, num_offsets = state.code.shape[1], state.offset_px.shape[1]
    J, T = np.empty(out.products.shape[2]), np.empty((3, 4))
    for car in range(np.uint64(len(state.code))):
        if not turn.moving[car]:
            continue
        out.cost[car] = 0.0
        for i in range(out.products.shape[1]):
            for k in range(out.products.shape[2]):
                out.products[car, i, k] = 0.0
        for i in range(3):
            for k in range(4):
                T[i, k] = state.T_obj_cam[car, i, k]
        add_ground(terms, columns.of_pose, car, T, J, out)
        if terms.pose_weight > 0:
            add_pose(terms, columns.of_pose, car, T, J, out)
        for k in range(num_codes):
            J[0] = 1.0
            add(terms.shape_weight, np.float64(state.code[car, k]), J, 1, columns.of_code + k, car, out)
        if terms.dimensions_weight > 0:
            add_dimensions(terms, columns.of_code, car, state.code[car], J, out)
        for k in range(num_offsets):
            sigma = np.float64(terms.offset_sigma_px[car, k])
            J[0] = 1.0 / sigma if sigma > 0 else 1.0
            add(terms.rig_weight, state.offset_px[car, k] * J[0], J, 1, columns.of_offset + k, car, out)


@step
def add(weight: float, residual: float, J: Doubles, size: int, first: int, car: Index, out: Sums) -> None:
    """Add `weight r^2 / 2`, whose Jacobian has `size` columns from the `first` one on."""
    products = out.products[car]
    out.cost[car] += 0.5 * weight * residual * residual
    for i in range(size):
        products[len(products) - 1, first + i] += weight * residual * J[i]
        for k in range(size):
            products[first + i, first + k] += weight * J[i] * J[k]


@step
def add_ground(terms: PriorArrays, first: int, car: Index, T: Doubles, J: Doubles, out: Sums) -> None:
    """Add the priors of height and tilt (`height_prior`, `tilt_prior_normal`, `tilt_prior_cosine`)."""
    normal = terms.ground_normal_cam[car]
    x = T[0, 0] * normal[0] + T[0, 1] * normal[1] + T[0, 2] * normal[2]
    y = T[1, 0] * normal[0] + T[1, 1] * normal[1] + T[1, 2] * normal[2]
    z = T[2, 0] * normal[0] + T[2, 1] * normal[1] + T[2, 2] * normal[2]
    height = (terms.ground_offset[car] - (x * T[0, 3] + y * T[1, 3] + z * T[2, 3])) / normal[1]
    J[0], J[1], J[2] = -x / normal[1], -y / normal[1], -z / normal[1]
    add(terms.height_weight, height, J, 3, first, car, out)
    if terms.tilts_by_cosine:
        J[0], J[1], J[2] = -z, 0.0, x
        add(terms.tilt_weight, 1.0 + y, J, 3, first + 3, car, out)
    else:
        J[0], J[1], J[2] = 0.0, z, -y
        add(terms.tilt_weight, x, J, 3, first + 3, car, out)
        J[0], J[1], J[2] = y, -x, 0.0
        add(terms.tilt_weight, z, J, 3, first + 3, car, out)


@step
def add_pose(terms: PriorArrays, first: int, car: Index, T: Doubles, J: Doubles, out: Sums) -> None:
    """Add the prior of origin and heading (`pose_prior`)."""
    at, sigma = terms.detector_T_cam_obj[car], terms.pose_sigma[car]
    distance = np.sqrt(np.float64(at[0, 3]) ** 2 + np.float64(at[2, 3]) ** 2)
    along_x, along_z = at[0, 3] / distance, at[2, 3] / distance
    axes = ((along_x, 0.0, along_z), (along_z, 0.0, -along_x), (0.0, 1.0, 0.0))
    # The rotation of the car to the camera is the transpose of R in T, and its origin is -R^T t.
    for axis in range(3):
        away, of = 0.0, axes[axis]
        for k in range(3):
            away += of[k] * (-(T[0, k] * T[0, 3] + T[1, k] * T[1, 3] + T[2, k] * T[2, 3]) - at[k, 3])
        for i in range(3):
            J[i] = -(of[0] * T[i, 0] + of[1] * T[i, 1] + of[2] * T[i, 2]) / sigma[axis]
        add(terms.pose_weight, away / sigma[axis], J, 3, first, car, out)
    heading = np.arctan2(T[0, 0] * at[2, 0] - T[0, 2] * at[0, 0], T[0, 0] * at[0, 0] + T[0, 2] * at[2, 0])
    per_turn = 1.0 / ((T[0, 0] * T[0, 0] + T[0, 2] * T[0, 2]) * sigma[3])
    J[0] = 0.0
    J[1] = (T[0, 2] * T[2, 0] - T[0, 0] * T[2, 2]) * per_turn
    J[2] = (T[0, 0] * T[1, 2] - T[0, 2] * T[1, 0]) * per_turn
    add(terms.pose_weight, heading / sigma[3], J, 3, first + 3, car, out)


@step
def add_dimensions(terms: PriorArrays, first: int, car: Index, code: Reals, J: Doubles, out: Sums) -> None:
    """Add the prior of height, width and length (`dimensions_prior`)."""
    for side in range(3):
        basis, sigma = terms.hwl_basis[side], np.float64(terms.hwl_sigma[side])
        size = np.float64(terms.hwl_mean[side])
        for k in range(len(code)):
            size += basis[k] * code[k]
            J[k] = basis[k] / sigma
        add(terms.dimensions_weight, (size - terms.detector_hwl[car, side]) / sigma, J, len(code), first, car, out)
