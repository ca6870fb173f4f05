"""Which functions hold hand-derived derivatives, and which tests must catch a mistake in them."""

from __future__ import annotations

from jacobian_mutants import targets_energy, targets_geometry_and_shape, targets_residuals
from jacobian_mutants.target import Target

__all__ = ["TARGETS", "Target"]

TARGETS: dict[str, Target] = {
    **targets_geometry_and_shape.TARGETS,
    **targets_residuals.TARGETS,
    **targets_energy.TARGETS,
}
