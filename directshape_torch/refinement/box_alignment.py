"""This baseline is the dense alignment of Stereo R-CNN (Li, Chen, Shen, CVPR 2019): only photometry sets the depth.

The lower half of the box's near sides stands for the car's surface, because box and surface are nearest to each other
there. All pixels of this half are moved in depth by an equal number of metres, to where the images agree best. The
search covers a wide range of disparities first and a narrow one afterwards. Dimensions and heading stay the detector's.
Stereo R-CNN differs in two points: this module takes the pixels of the instance mask, and the norm of the photometric
term.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.refinement.disparity_profile import (
    disparity_profile,
    profile_figures,
    profile_offsets,
    shifted_costs,
)
from directshape_torch.refinement.outcome import at_states
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.rows import CarSums, ObjectRays, Rays
from directshape_torch.solver.problem import where_rows
from directshape_torch.state.cars import CarBatch, CarState, move_by_disparity
from directshape_torch.status import Status
from directshape_torch.terms.depth import Hits
from directshape_torch.terms.photometric import Photometric, Surface

# These are the range and the step of each search. The wide search runs twice, because near cars may begin further away
# than one search reaches.
_ROUNDS_PX = ((3.0, 0.25), (3.0, 0.25), (0.5, 0.05))
# These are the lower and the upper corner of a box, and the top of its lower half, in units of length, height and
# width.
_UNIT_BOX = (-0.5, -1.0, -0.5, 0.5, 0.0, 0.5)
_TOP = -0.5


@torch.no_grad()
def align_boxes(problem: CarProblem, initial: CarState, cars: CarBatch, came: RefinementResult) -> RefinementResult:
    """Move the detector's boxes of B cars along the viewing rays of their origins to the lowest photometric cost.

    `came` holds what is known of the cars before the
    call. The status of a car is `converged`, `no_match` where the cost has no
    valley in the last range, or `non_finite`.
    """
    state = initial
    for range_px, step_px in _ROUNDS_PX:
        term, surface = _begun(problem, state, cars)
        offsets = profile_offsets(range_px, step_px).to(state.code.device)
        moved_m = torch.stack([_depth(move_by_disparity(state, cars.focal_baseline, x)) for x in offsets.tolist()])
        costs = moved_costs(term, surface, moved_m - _depth(state))
        found = profile_figures(offsets, costs, term.pixel_set.support)
        state = move_by_disparity(state, cars.focal_baseline, found.offset_px.nan_to_num(0.0).to(state.code))
    converged = found.sigma_px.isfinite()
    status = torch.where(converged, Status.converged.code, Status.no_match.code)
    finite = costs.isfinite().all(dim=1) & cars.detector_hwl.isfinite().all(dim=1)
    status = torch.where(finite, status, Status.non_finite.code)
    term, at_end = _begun(problem, state, cars)
    at_input = term.where(problem.look(initial)._replace(hits=_near_sides(problem, initial, cars)))
    profile = disparity_profile(term, at_input, at_end, len(cars), state.code)
    before, after = (cost[:, None] for cost in profile.cost_at(0.0))
    result = replace(
        came,
        status_code=status,
        iterations=torch.full_like(status, len(_ROUNDS_PX)),
        cost_before=before,
        cost_after=after,
        profile=profile,
        has_shape=False,
    )
    return at_states(result, where_rows(converged, state, initial))


def box_hits(
    rays: Rays,
    T_obj_cam: Tensor,  # (B, 4, 4)
    dimensions_hwl: Tensor,  # (B, 3) metres
) -> Hits:
    """The points where rays enter the boxes of their cars; only points on the lower halves are marked as found."""
    in_objects = rays.in_objects(T_obj_cam)
    size = dimensions_hwl.roll(1, dims=1)[rays.owner].mT[..., None]  # (3, M, 1) length, height, width
    in_unit_box = ObjectRays(*(x / size for x in in_objects))
    inside = in_unit_box.interval(constant_like(_UNIT_BOX, size).view(2, 3))
    normal = torch.where(inside.enters == inside.near, -in_objects.direction_obj.sign(), 0.0)
    found = inside.hit & (in_unit_box.at(inside.near)[1] > _TOP)
    return Hits(in_objects.at(inside.near), normal, found, inside.near)


def moved_costs(
    term: Photometric,
    surface: Surface,
    moved_m: Tensor,  # (S, B)
) -> Tensor:
    """Costs (B, S), float64, of B cars when the depths of all their pixels are changed by each of S amounts."""
    rows, owner = term.pixel_set.rows, term.blocks.owner
    sums, no_shift = CarSums.of(owner, len(term.cars)), torch.zeros_like(rows.rays.centre_cam[:, 0])
    everything = torch.ones_like(rows.pixel_weight)[None]

    def cost(metres: Tensor) -> Tensor:
        depth, on_surface = (surface.depth + metres[owner, None])[None], surface.on_surface[None]
        costs = shifted_costs(rows, term.config, everything, depth, on_surface, no_shift, metres.new_zeros(1))
        return sums.sum(costs[0, 0, 0])

    return torch.stack([cost(metres) for metres in moved_m], dim=1)


def _begun(problem: CarProblem, state: CarState, cars: CarBatch) -> tuple[Photometric, Surface]:
    """The photometric term with the pixels of the near sides, and the surface of these sides."""
    sight = problem.look(state)._replace(hits=_near_sides(problem, state, cars))
    term = problem.begin(-1, sight).photometric
    assert term is not None, "the problem of the method has this term alone"
    return term, term.where(sight)


def _near_sides(problem: CarProblem, state: CarState, cars: CarBatch) -> Hits:
    return box_hits(problem.rays[0], state.T_obj_cam, cars.detector_hwl)


def _depth(state: CarState) -> Tensor:
    """Depth (B,) of the object origins in the left camera, metres."""
    return se3.inverse(state.T_obj_cam)[:, 2, 3]
