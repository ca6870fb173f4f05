"""This module defines what loops are called with; it needs no Numba."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Real: TypeAlias = Any
"""A float32: a plain number would be float64 to Numba."""
Reals: TypeAlias = NDArray[np.float32]
Doubles: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Index: TypeAlias = Any
"""An unsigned integer of 64 bits."""
Point: TypeAlias = tuple[Real, Real, Real]
Points: TypeAlias = Any
"""Coordinates x, y and z of points, (R,) each."""
Corners: TypeAlias = tuple[tuple[Real, Real, Real, Real], tuple[Real, Real, Real, Real]]
"""Signed distances at the corners 00, 10, 01, 11 of x and y of a cell; the second four are one node further along z."""


def singles(*numbers: float) -> list[Any]:
    """Numbers in single precision."""
    return [np.float32(number) for number in numbers]


class Grid(NamedTuple):
    """A `Grid` is a `GridShape` of B cars, and the constants of searches in it."""

    values: Reals  # (B * nodes,) signed distance at the nodes, metres
    basis: Reals  # (nodes, K)
    nodes: Index  # number of nodes of one car
    stride_x: Index  # nodes from one cell to the next along x and y; 1 along z
    stride_y: Index
    last: Point  # number of the last node along each axis
    origin: Point  # node (0, 0, 0) in the object frame, metres
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


class Turn(NamedTuple):
    """A `Turn` says for B cars what a loop over blocks does with theirs."""

    moving: Flags  # (B,) whether the blocks are evaluated
    # (B,) whether they begin at the points where their last evaluation ended, and not at those where it began
    taken: Flags


class Search(NamedTuple):
    """A `Search` holds the bounds of a prior and the constants of `terms.depth` for searches of closest points."""

    lower: Point  # metres, in the object frame
    upper: Point
    margin_m: Real
    at_end_m: Real
    least_second_difference_m: Real
    least_direction: Real  # of `rows`


class ClosestArrays(NamedTuple):
    """`ClosestArrays` are the fields of `terms.depth.Closest`."""

    points_obj: Reals  # (3, M, R)
    depth: Reals  # (M, R)
    crosses: Flags  # (M, R)
    face_obj: Reals  # (3, M, R)


class HitsArrays(NamedTuple):
    """`HitsArrays` are the fields of `terms.depth.Hits`."""

    points_obj: Reals  # (3, M, R)
    normal_obj: Reals  # (3, M, R)
    found: Flags  # (M, R)
    depth: Reals  # (M, R)


class Contour(NamedTuple):
    """A `Contour` holds the masks of M blocks and the constants of `terms.silhouette` and of tracking."""

    foreground: Reals  # (M, R)
    filled: Reals  # (M, R)
    zeta: Reals  # (M, 1)
    saturation: Real
    residual_floor: Real
    sample_m: Real
    next_cell: Real
    max_cells: int


class Columns(NamedTuple):
    """`Columns` are the first columns of the blocks of the tangent, as `state.unknowns` orders them."""

    of_pose: int
    of_code: int
    of_offset: int


class Sums(NamedTuple):
    """`Sums` are the fields of `terms.term.Part` of M blocks that a loop writes, and which columns the term sees."""

    first: int
    num_columns: int
    cost: Doubles  # (M,)
    products: Doubles  # (M, D + 1, D)
    information: (
        Doubles  # (M, D, D), or (M, 0, 0) where the Fisher matrix is not wanted or is the matrix of the products
    )
    residual: Reals  # (M, R, N)


class SurfaceArrays(NamedTuple):
    """`SurfaceArrays` are the fields of `terms.photometric.Surface`."""

    points_obj: Reals  # (3, M, R)
    normal_obj: Reals  # (3, M, R)
    depth: Reals  # (M, R)
    on_surface: Flags  # (M, R)
    usable: Flags  # (M, R)


class Tracking(NamedTuple):
    """`Tracking` holds the constants with which `terms.depth` and `terms.photometric` track surfaces."""

    secants: int
    max_step_m: Real
    least_step_m: Real
    flattest_share: Real
    least_slope: Real
    near_surface_m: Real
    least_ray_cosine: Real
    least_share: Real


class Pixels(NamedTuple):
    """`Pixels` are the fields of `terms.photometric_rows.PhotometricRows` and of its `RightView`."""

    along_ray: Reals  # (3, N, M, R)
    along_baseline: Reals  # (3, M, R)
    intensity_left: Reals  # (N, M, R)
    pixel_weight: Reals  # (M, R)
    neighbour_weight: Reals  # (N, M, R)
    right: Reals  # (A,)
    frame: NDArray[np.int32]  # (M, 4)
    to_full: Reals  # (M, 2)
    crop: NDArray[np.int64]  # (M, 6)
    in_front: Reals  # (M, 2)
    covering: Reals  # (A, 2)


class Comparison(NamedTuple):
    """A `Comparison` holds the constants with which pixels are compared with the right image."""

    lost_grey_levels: Real
    huber_grey_levels: Real
    least_depth_m: Real
    centre: int  # which neighbour is the pixel itself


class Offsets(NamedTuple):
    """`Offsets` are those of the disparity of B cars."""

    px: Reals  # (B, S)
    inverse_depth_per_px: Reals  # (B, S) change of the inverse depth by a pixel


class States(NamedTuple):
    """`States` are the tensors of a `CarState`."""

    T_obj_cam: Reals  # (B, 4, 4)
    code: Reals  # (B, K)
    offset_px: Reals  # (B, S)


class Energies(NamedTuple):
    """`Energies` are costs, gradients and Gauss-Newton matrices of B cars."""

    cost: Doubles  # (B,)
    gradient: Doubles  # (B, D)
    hessian: Doubles  # (B, D, D)


class Iterated(NamedTuple):
    """`Iterated` is what changes from iteration to iteration, see `solver.problem.Progress`."""

    damping: Doubles  # (B,)
    stretched: Flags  # (B,)
    ended: NDArray[np.int64]  # (B,)
    iterations: NDArray[np.int64]  # (B,)


class Steps(NamedTuple):
    """`Steps` are what B cars try in an iteration."""

    step: Doubles  # (B, D)
    size: Doubles  # (B,) see `solver.damped_solve.step_size`
    solvable: Flags  # (B,)


class Rules(NamedTuple):
    """`Rules` are the settings of a stage's iterations and the constants of the solver."""

    columns: Columns
    largest_step: Doubles  # (D,) trusted
    held: Flags  # (D,) whether the stage fixes an unknown
    max_code: float
    over_relaxation: float
    step_tolerance: float
    cost_tolerance: float
    changes_damping: bool
    damping_decrease: float
    damping_increase: float
    least_damping: float
    most_damping: float
    flat: float
    least_diagonal: float  # share of the largest entry
    least_pivot: float
    converged: int  # codes of statuses
    singular: int


class Family(NamedTuple):
    """A `Family` is a `PCAShapePrior`, and the grids of B cars: a grid is the mean and the code times the basis."""

    mean: Reals  # (nodes,)
    basis: Reals  # (K, nodes)
    values: Reals  # (B * nodes,)


class StageRun(NamedTuple):
    """A `StageRun` is what the iterations of a stage read and write."""

    rules: Rules
    family: Family
    rest: Doubles  # (B,) cost of rows that cannot change
    state: States
    at: Energies  # at the state
    progress: Iterated
    turn: Turn
    steps: Steps
    candidate: States  # the state after the step
    at_candidate: Energies


class BlockSums(NamedTuple):
    """`BlockSums` are what the blocks of a term add to their cars."""

    owner: NDArray[np.int64]  # (M,)
    weight: Doubles  # (M,)
    cost: Doubles  # (M,)
    products: Doubles  # (M, D + 1, D)


class PriorArrays(NamedTuple):
    """`PriorArrays` are the weights and constants of `terms.priors`; a prior of weight 0 is left out."""

    shape_weight: float
    height_weight: float
    tilt_weight: float
    dimensions_weight: float
    pose_weight: float
    rig_weight: float
    tilts_by_cosine: bool
    ground_normal_cam: Reals  # (B, 3)
    ground_offset: Reals  # (B,)
    detector_hwl: Reals  # (B, 3)
    hwl_mean: Reals  # (3,) of the family of shapes
    hwl_basis: Reals  # (3, K)
    hwl_sigma: Reals  # (3,)
    detector_T_cam_obj: Reals  # (B, 4, 4)
    pose_sigma: Reals  # (B, 4)
    offset_sigma_px: Reals  # (B, S)


class SeenFromAbove(NamedTuple):
    """`SeenFromAbove` holds the fields of `start.rectangle_fit.InstancePoints`."""

    xz: Reals  # (M, P, 2)
    weight: Reals  # (M, P)
    middle: Reals  # (M, 2)
    outline: Reals  # (M, 2)
    is_end_seen: Flags  # (M, 2)


class RectangleRules(NamedTuple):
    """`RectangleRules` are the constants of `start.rectangle_fit`."""

    num_iterations: int
    damping: float
    largest_step: Doubles  # (5,)
    mean_size: tuple[float, float]  # length and width, metres
    size_sigma: tuple[float, float]
    size_weight: float
    point_scale: float
    outline_scale: float
    outline_weight: float
    corners: Doubles  # (8, 2) in lengths and widths
    least_depth: float
