"""This module defines what loops are called with; it needs no Numba."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Real: TypeAlias = np.float32
Reals: TypeAlias = NDArray[np.float32]
Doubles: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Index: TypeAlias = Any
"""An unsigned integer; NumPy's and Numba's rules for their sums differ, and Numba's hold."""
Point: TypeAlias = tuple[Real, Real, Real]


class Grid(NamedTuple):
    """A `Grid` is a `GridShape` of B cars with the bounds of its prior, and the small numbers of searches in it."""

    values: Reals  # (B * nodes,) signed distance at the nodes, metres
    basis: Reals  # (nodes, K)
    nodes: Index  # number of nodes of one car
    stride_x: Index  # nodes from one cell to the next along x and y; 1 along z
    stride_y: Index
    last: Point  # number of the last node along each axis
    origin: Point  # node (0, 0, 0) in the object frame, metres
    lower: Point  # bounds of the prior in the object frame, metres
    upper: Point
    spacing_m: Real
    per_m: Real  # cells per metre
    on_face: Real  # the constants of `shape.sdf_grid`
    no_step: Real
    beyond_grids: Real


class Rays(NamedTuple):
    """`Rays` are the rays of M blocks in the left camera's frame, and the poses of their cars (`rows.Rays`)."""

    owner: NDArray[np.int64]  # (M,)
    centre_cam: Reals  # (M, 3)
    ray_cam: Reals  # (3, M, R)
    T_obj_cam: Reals  # (B, 4, 4)


class Search(NamedTuple):
    """A `Search` holds the constants of `terms.depth` for searches of closest points."""

    margin_m: Real
    at_end_m: Real
    least_second_difference_m: Real
    least_direction: Real  # of `rows`


class ClosestOut(NamedTuple):
    """`ClosestOut` is where the fields of `terms.depth.Closest` are written."""

    points_obj: Reals  # (3, M, R)
    depth: Reals  # (M, R)
    crosses: Flags  # (M, R)
    face_obj: Reals  # (3, M, R)


class HitsOut(NamedTuple):
    """`HitsOut` is where the fields of `terms.depth.Hits` are written."""

    points_obj: Reals  # (3, M, R)
    normal_obj: Reals  # (3, M, R)
    found: Flags  # (M, R)
    depth: Reals  # (M, R)
