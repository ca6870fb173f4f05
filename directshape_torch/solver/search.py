"""A search over a few start states before the first step: cheap in a batch, and decisive for far cars."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.config import SearchConfig
from directshape_torch.geometry import se3
from directshape_torch.problem import CarProblem
from directshape_torch.solver.problem import where_rows
from directshape_torch.terms.cars import CarBatch, CarState


def search_start(problem: CarProblem, initial: CarState, cars: CarBatch, config: SearchConfig) -> CarState:
    """The cheapest of the input state and its moved copies, for each car by itself, at the first stage's settings."""
    if not config.disparity_offsets_px and not config.yaw_offsets_deg:
        return initial
    seen = problem.look(initial)
    stage = problem.begin(problem.stages()[0], seen)
    best, best_cost = initial, stage.figures(seen).cost

    def keep_cheaper(candidate: CarState) -> tuple[CarState, Tensor]:
        cost = stage.figures(problem.look(candidate)).cost
        cheaper = cost < best_cost
        return where_rows(cheaper, candidate, best), torch.where(cheaper, cost, best_cost)

    for offset_px in config.disparity_offsets_px:
        best, best_cost = keep_cheaper(move_by_disparity(initial, cars.focal_baseline, offset_px))
    base = best
    for offset_deg in config.yaw_offsets_deg:
        best, best_cost = keep_cheaper(turn(base, math.radians(offset_deg)))
    return best


def move_by_disparity(state: CarState, focal_baseline: Tensor, offset_px: float | Tensor) -> CarState:
    """Cars moved along the viewing ray of their origin so that its disparity grows by `offset_px`, (B,) or one."""
    T_cam_obj = se3.inverse(state.T_obj_cam)
    origin = T_cam_obj[:, :3, 3]
    disparity = focal_baseline / origin[:, 2]
    scale = disparity / (disparity + offset_px).clamp_min(0.1)
    moved = se3.from_rotation_translation(T_cam_obj[:, :3, :3], origin * scale[:, None])
    return state._replace(T_obj_cam=se3.inverse(moved))


def turn(state: CarState, angle_rad: float) -> CarState:
    """Cars turned about the vertical axis of their own object frame."""
    twist = torch.zeros(6, dtype=state.code.dtype, device=state.code.device)
    twist[4] = angle_rad
    return state._replace(T_obj_cam=se3.exp(twist) @ state.T_obj_cam)
