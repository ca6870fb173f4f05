"""All prior terms of a batch of cars at once: the sums of the terms by themselves, in a few small operations.

The rows of height, tilt and pose come from one product with constants (`pose_rows`), what is linear in the code has
constant slopes, and one square of them all is the whole matrix; dimensions that are curved in the code add theirs.
With five cars the terms one by one are hundreds of operations on a handful of numbers each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeGuard

import torch
from torch import Tensor

from directshape_torch.device_constants import constant_like
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.pose_rows import (
    beside_codes,
    cosine_rows,
    heading_constants,
    heading_rows,
    level_rows,
    no_rows,
    pose_features,
    position_rows,
    without_heading,
)
from directshape_torch.energy.prior_terms import (
    DimensionsResidual,
    HeightResidual,
    PoseResidual,
    PriorTerm,
    ShapeResidual,
    TiltResidual,
    detector_pose_sigma,
)
from directshape_torch.energy.term import Term
from directshape_torch.errors import InputError
from directshape_torch.residuals.priors import viewing_axes
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.tracking.blocks import BlockParts

_TWIST = 6


@dataclass(frozen=True)
class _Dimensions:
    """The prior of the dimensions: three rows by the code."""

    prior: ShapePrior
    detector_hwl: Tensor  # (B, 3, 1) float64
    scale: Tensor  # (B, 3, 1) root of the weight over sigma

    @property
    def are_linear(self) -> bool:
        """Has the code a constant influence on the dimensions?"""
        # A class made from this one may have dimensions of its own.
        return type(self.prior) is PCAShapePrior

    def rows(self, code: Tensor) -> Tensor:
        """`[J r]` at codes (B, K), (B, 3, K + 1), in float64 from the dimensions on."""
        at = self.prior.dimensions_and_derivative(code)
        residual = at.hwl.to(torch.float64)[..., None] - self.detector_hwl
        return torch.cat([at.J_hwl_code.to(torch.float64), residual], dim=2) * self.scale

    def of_objects(self, index: Tensor) -> _Dimensions:
        """Those of the cars with these numbers."""
        return _Dimensions(self.prior, self.detector_hwl.index_select(0, index), self.scale.index_select(0, index))


@dataclass(frozen=True)
class StackedPriors:
    """The sum of several `PriorTerm`s, in float64 throughout but for the dimensions that a shape prior computes itself.

    Rows are `[J r]`, times the roots of the terms' weights: their square has matrix, gradient and cost.

    Attributes:
        pose_rows: (B, R (D + 1), F) from the features of a pose to the rows of its priors.
        heading: (B, 4, 2) of `heading_constants`; None where no prior asks for the heading.
        code_slopes: (B, Q, D) of priors that are linear in the code.
        code_rest: (B, Q, 1) their residuals at the code 0.
        dimensions: priors of dimensions that are not linear in the code.
    """

    pose_rows: Tensor
    heading: Tensor | None
    code_slopes: Tensor
    code_rest: Tensor
    dimensions: tuple[_Dimensions, ...]

    @staticmethod
    def takes(term: Term) -> TypeGuard[PriorTerm]:
        """Is the term one of the priors that can be stacked, and not a user's own?"""
        known = ShapeResidual, HeightResidual, TiltResidual, DimensionsResidual, PoseResidual
        # Not by `isinstance`: a class made from one of these has a residual of its own.
        return type(term) is PriorTerm and type(term.residual_of) in known

    @classmethod
    def from_terms(cls, terms: Sequence[PriorTerm], num_codes: int, factors: Tensor | None = None) -> StackedPriors:
        """The sum of these terms.

        Args:
            terms: T priors of the same B cars, at least one, each of a kind that `takes` accepts.
            num_codes: K.
            factors: (B, T) by which the terms of each car are multiplied beside their own weights; None for 1.

        Raises:
            InputError: no term, or one of an unknown kind.
        """
        strange = [term.name for term in terms if not cls.takes(term)]
        if strange or not terms:
            raise InputError("terms", "at least one prior, all of known kinds", ", ".join(strange) or "none")
        scaled = list(zip(terms, _roots_of_weights(terms, factors), strict=True))
        pose_rows = torch.cat([_pose_rows(term, root) for term, root in scaled], dim=1)
        code_rows = torch.cat([_code_rows(term, root, num_codes) for term, root in scaled], dim=1)
        sees_heading = any(isinstance(term.residual_of, PoseResidual) for term in terms)
        dimensions = (_dimensions(term, root) for term, root in scaled)
        pose_rows = beside_codes(pose_rows if sees_heading else without_heading(pose_rows), num_codes)
        slopes, rest = torch.split_with_sizes(code_rows, [num_codes, 1], dim=2)
        return cls(
            pose_rows=pose_rows.flatten(1, 2),
            heading=heading_constants(terms[0].cars.detector_T_cam_obj.to(torch.float64)) if sees_heading else None,
            code_slopes=torch.nn.functional.pad(slopes, (_TWIST, 0)),
            code_rest=rest,
            dimensions=tuple(d for d in dimensions if d is not None and not d.are_linear),
        )

    def parts(self, state: CarState) -> BlockParts:
        """Cost (B,), and Gauss-Newton matrix with the gradient as one more row, (B, D + 1, D).

        The matrix is the Fisher matrix too. Differentiable by autograd, forward and again.
        """
        code = state.code.to(torch.float64).unsqueeze(2)
        columns = _TWIST + code.shape[1] + 1
        of_pose = torch.bmm(self.pose_rows, pose_features(state.T_obj_cam.to(torch.float64), self.heading))
        residual = torch.baddbmm(self.code_rest, self.code_slopes[:, :, _TWIST:], code)
        of_code = torch.cat([self.code_slopes, residual], dim=2)
        rows = torch.cat([of_pose.view(len(code), of_pose.shape[1] // columns, columns), of_code], dim=1)
        squares = torch.bmm(rows.mT, rows)
        for dimensions in self.dimensions:
            curved = dimensions.rows(state.code)
            squares[:, _TWIST:, _TWIST:] += torch.bmm(curved.mT, curved)
        return BlockParts(0.5 * squares[:, -1, -1], squares[:, :, :-1])

    def of_objects(self, keep: Tensor, count: int | None = None) -> StackedPriors:
        """Those of the cars where `keep` (B,) bool holds; so many (`count`), or the host asks for their number."""
        kept = keep.nonzero() if count is None else torch.nonzero_static(keep, size=count)
        index = kept[:, 0]
        return StackedPriors(
            self.pose_rows.index_select(0, index),
            None if self.heading is None else self.heading.index_select(0, index),
            self.code_slopes.index_select(0, index),
            self.code_rest.index_select(0, index),
            tuple(dimensions.of_objects(index) for dimensions in self.dimensions),
        )


def _roots_of_weights(terms: Sequence[PriorTerm], factors: Tensor | None) -> list[Tensor]:
    """For each term the root (B,) of its weight for each car."""
    ones = torch.ones_like(terms[0].cars.input_depth, dtype=torch.float64)
    roots = [math.sqrt(term.weight) * ones for term in terms]
    if factors is None:
        return roots
    return [root * factor.to(torch.float64).sqrt() for root, factor in zip(roots, factors.unbind(dim=1), strict=True)]


def _pose_rows(term: PriorTerm, root: Tensor) -> Tensor:
    """Rows (B, R, 7, F) of a prior of the pose times `root` (B,); none of another prior."""
    cars, normal = term.cars, term.cars.ground_normal_cam.to(torch.float64)
    match term.residual_of:
        case HeightResidual():
            scale = (root / normal[:, 1])[:, None]
            return position_rows((scale * normal)[:, None], scale * cars.ground_offset[:, None])
        case TiltResidual("normal"):
            return level_rows(root[:, None] * normal)
        case TiltResidual("cosine"):
            return cosine_rows(root[:, None] * normal, root)
        case PoseResidual(config):
            scale = root[:, None] / detector_pose_sigma(config, cars)
            origin = cars.detector_T_cam_obj[:, :3, 3].to(torch.float64)
            axes = scale[:, :3, None] * viewing_axes(origin)
            return torch.cat([position_rows(axes, -(axes @ origin[..., None])[..., 0]), heading_rows(scale[:, 3])], 1)
        case _:
            return no_rows(normal)


def _code_rows(term: PriorTerm, root: Tensor, num_codes: int) -> Tensor:
    """Rows `[J r]` (B, R, K + 1) at the code 0 of a prior that is linear in it, times `root` (B,); else none."""
    dimensions = _dimensions(term, root)
    if dimensions is not None and dimensions.are_linear:
        return dimensions.rows(dimensions.prior.initial_code(len(root)))
    if isinstance(term.residual_of, ShapeResidual):
        return root[:, None, None] * torch.eye(num_codes, num_codes + 1, dtype=root.dtype, device=root.device)
    return root.new_zeros(len(root), 0, num_codes + 1)


def _dimensions(term: PriorTerm, root: Tensor) -> _Dimensions | None:
    match term.residual_of:
        case DimensionsResidual(prior, sigma_hwl_m):
            scale = root[:, None] / constant_like(sigma_hwl_m, root)
            return _Dimensions(prior, term.cars.detector_hwl.to(torch.float64)[..., None], scale[..., None])
        case _:
            return None
