"""What a stage and the trust region say of the unknowns: which of them move, and how far."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig, Unknowns
from directshape_torch.device_constants import constant_like
from directshape_torch.solver.problem import Linearisation


def moving_unknowns(unknowns: Unknowns, code: Tensor) -> Tensor:
    """Unknowns (D,) that the stage moves."""
    is_motion = torch.arange(6 + code.shape[1], device=code.device) < 6
    return is_motion if unknowns == "pose" else ~is_motion if unknowns == "shape" else is_motion | ~is_motion


def without_held(at: Linearisation, unknowns: Unknowns) -> Linearisation:
    """What the solver sees of it: an unknown that the stage holds has no slope and a curvature of its own."""
    if unknowns == "both":
        return at
    moving = moving_unknowns(unknowns, at.gradient[:, 6:])
    identity = torch.eye(len(moving), dtype=at.hessian.dtype, device=at.hessian.device)
    hessian = torch.where(moving[:, None] & moving, at.hessian, identity)
    return Linearisation(at.cost, torch.where(moving, at.gradient, torch.zeros_like(at.gradient)), hessian)


def step_limits(config: SolverConfig, num_codes: int, device: torch.device) -> Tensor:
    """Largest trusted step (D,) of each unknown, float64; not to be written to."""
    limits = [config.max_step_translation_m] * 3 + [config.max_step_rotation_rad] * 3
    limits += [config.max_step_code] * num_codes
    return constant_like(tuple(limits), torch.empty(0, dtype=torch.float64, device=device))
