"""A search over a few start states before the first step: cheap in a batch, and decisive for far cars."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.config import SearchConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3
from directshape_torch.solver.problem import where_rows


def search_start(problem: CarProblem, initial: CarState, cars: CarBatch, config: SearchConfig) -> CarState:
    """The cheapest of the input state and its moved copies, for each car by itself, at the first stage's settings."""
    if not config.disparity_offsets_px and not config.yaw_offsets_deg:
        return initial
    problem.begin_stage(problem.stages()[0], initial)
    best, best_cost = initial, problem.cost(initial)
    for offset_px in config.disparity_offsets_px:
        best, best_cost = _keep_cheaper(
            problem, best, best_cost, move_by_disparity(initial, cars.focal_baseline, offset_px)
        )
    base = best
    for offset_deg in config.yaw_offsets_deg:
        best, best_cost = _keep_cheaper(problem, best, best_cost, turn(base, math.radians(offset_deg)))
    return best


def _keep_cheaper(
    problem: CarProblem, best: CarState, best_cost: Tensor, candidate: CarState
) -> tuple[CarState, Tensor]:
    cost = problem.cost(candidate)
    cheaper = cost < best_cost
    return where_rows(cheaper, candidate, best), torch.where(cheaper, cost, best_cost)


def move_by_disparity(state: CarState, focal_baseline: Tensor, offset_px: float) -> CarState:
    """Cars moved along the viewing ray of their origin so that its disparity grows by `offset_px`."""
    T_cam_obj = se3.inverse(state.T_obj_cam)
    origin = T_cam_obj[:, :3, 3]
    disparity = focal_baseline / origin[:, 2]
    scale = disparity / (disparity + offset_px).clamp_min(0.1)
    moved = se3.from_rotation_translation(T_cam_obj[:, :3, :3], origin * scale[:, None])
    return CarState(se3.inverse(moved), state.code)


def turn(state: CarState, angle_rad: float) -> CarState:
    """Cars turned about the vertical axis of their own object frame."""
    twist = torch.zeros(6, dtype=state.code.dtype, device=state.code.device)
    twist[4] = angle_rad
    return CarState(se3.exp(twist) @ state.T_obj_cam, state.code)
