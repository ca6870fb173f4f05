"""This module has the priors `lambda r^2 / 2` on shape code, height above the ground, tilt, detector's box and rig.

A function of the cars and a state returns each residual with its Jacobian by the unknowns that it sees. A user's prior
is a function of this kind in a `PriorTerm` (docs/extra_terms.md). The derivations are in docs/derivations/priors.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple, cast

import torch
from torch import Tensor
from torch.nn.functional import pad

from directshape_torch.config import PriorConfig
from directshape_torch.errors import InputError, shown
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import viewing_axes
from directshape_torch.kernels.arguments import PriorArrays, States, Turn
from directshape_torch.kernels.choice import array, native_grid
from directshape_torch.numerics.checks import check_alike, check_shape
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.rows import Blocks
from directshape_torch.shape.field import Field
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import DimensionsDerivative, ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, State
from directshape_torch.terms import robust
from directshape_torch.terms.term import AnyTerm, Linear, NativeLoop, NoAnchor, Term, native_columns, part_to_write

PRIORS = "shape", "height", "tilt", "dimensions", "pose", "rig"
"""These are the names of all priors."""
RIG_WEIGHT = 0.2
"""The offset of the disparity, in standard deviations, has the weight of the detector's pose."""


class PriorResidual(NamedTuple):
    """A `PriorResidual` is the residual of a prior for B cars, with its Jacobian."""

    residual: Tensor  # (B, R)
    J_residual_state: Tensor  # (B, R, S) by the unknowns that the term sees, block after block


@dataclass(frozen=True)
class PriorTerm(Term[NoAnchor]):
    """A `PriorTerm` costs `weight * sum_i r_i^2 / 2` for a residual of the state; each car has one block of R rows.

    Raises:
        InputError: the weight is no number; a value is no tensor with a row for each detection of the call, or has
            another device or, in floating point, another dtype than the cars.
    """

    name: str  # name of the term
    weight: float  # lambda
    cars: CarBatch  # constants of the cars
    # The function takes the constants, a state and, by name, the rows (B, ...) of the values. It returns the residual
    # with its Jacobian, or the residual (B, R) alone, which is then differentiated automatically.
    residual_of: Callable[..., PriorResidual | Tensor]
    num_rows: int  # R
    sees: tuple[str, ...] = (POSE, CODE)  # the blocks of unknowns of its Jacobian
    is_prior: bool = True  # false for a part of the measurements
    # Further values that the residual needs for each car are tensors (N, ...) of all N detections of the call.
    values: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        called, depth = f"extra term {self.name!r}", self.cars.input_depth
        if not isinstance(self.weight, (int, float)):
            cure = f"give each car its own by refiner(..., term_weights={{{self.name!r}: (N,)}})"
            raise InputError(f"{called}: weight", "a number", shown(self.weight), cure)
        for name, value in self.values.items():
            named = f"{called}: values[{name!r}]"
            rest = getattr(value, "shape", ())[1:]
            cure = "give the rows of all detections of the call in their order; those of the cars are found here"
            check_shape(named, value, (self.cars.num_detections, *rest), cure)
            check_alike(named, value, "the cars", depth if value.is_floating_point() else depth.to(value.dtype))

    def _at(self, state: State) -> PriorResidual | Tensor:
        """The result of `residual_of` at a state, with the values of the remaining cars."""
        rows = self.cars.detection_row
        at = self.residual_of(self.cars, state, **{name: x.index_select(0, rows) for name, x in self.values.items()})
        if not isinstance(at, (Tensor, PriorResidual)):
            cure = "return the residual as a tensor (B, R), or PriorResidual(residual, J)"
            raise InputError(f"extra term {self.name!r}: its residual", "a Tensor or a PriorResidual", shown(at), cure)
        return at

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name,)

    @property
    def blocks(self) -> Blocks:
        return Blocks.one_each(len(self.cars), self.cars.frame_index.device)

    @property
    def block_weight(self) -> Tensor:
        return torch.full_like(self.cars.input_depth, self.weight, dtype=torch.float64)

    @property
    def information(self) -> Tensor:
        return self.block_weight

    @property
    def row_weight(self) -> Tensor:
        return torch.ones_like(self.cars.input_depth, dtype=torch.float64).expand(self.num_rows, 1, -1).movedim(-1, 0)

    def linear(self, field: Field, state: State, anchor: NoAnchor) -> Linear[NoAnchor]:
        at = self._at(state)
        if isinstance(at, Tensor):
            residual, J = state.unknowns.derivative(lambda moved: self.residual(field, moved, anchor), state)
            return Linear(residual, torch.ones_like(residual), J[:, :, 0], anchor)
        residual = at.residual.to(torch.float64)[..., None]
        return Linear(residual, torch.ones_like(residual), at.J_residual_state.to(torch.float64), anchor)

    def residual(self, field: Field, state: State, anchor: NoAnchor) -> Tensor:
        at = self._at(state)
        return (at if isinstance(at, Tensor) else at.residual).to(torch.float64)[..., None]

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.quadratic(residual)


@dataclass(frozen=True)
class CarPrior(PriorTerm):
    """A `CarPrior` is a prior of `prior_terms`, or several of them in one term."""

    config: PriorConfig = field(kw_only=True)
    prior: ShapePrior = field(kw_only=True)
    # Weights in the residuals, by the names of the priors that one term joins; None for a prior by itself.
    joined: Mapping[str, float] | None = field(default=None, kw_only=True)

    def native_loop(
        self, field: Field, state: State, anchor: NoAnchor, fisher: bool, turn: Turn
    ) -> NativeLoop[NoAnchor] | None:
        is_known = type(self) is CarPrior and type(self.prior) is PCAShapePrior
        if not is_known or native_grid(field, state.T_obj_cam, self.cars.input_depth) is None:
            return None
        from directshape_torch.kernels.priors import priors  # Numba may be missing.

        # Nobody reads the residuals of priors.
        part, sums = part_to_write(self, state, anchor, (len(self.cars), 0, 1), False)
        states = States(*map(array, tuple(state)[:3]))
        columns = native_columns(state.unknowns)
        return NativeLoop(partial(priors, self._constants, columns, states, turn, sums), part)

    @cached_property
    def _constants(self) -> PriorArrays:
        cars, prior, like = self.cars, cast(PCAShapePrior, self.prior), self.cars.input_depth
        own = {self.name: 1.0} if self.joined is None else self.joined
        pose_sigma = detector_pose_sigma(self.config, cars) if "pose" in own else like.new_empty(len(cars), 4)
        no_offset = like.new_empty(len(cars), 0)
        weights = {f"{name}_weight": float(own.get(name, 0.0)) for name in PRIORS}
        return PriorArrays(
            **weights,
            tilts_by_cosine=self.config.tilt_form == "cosine",
            ground_normal_cam=array(cars.ground_normal_cam),
            ground_offset=array(cars.ground_offset),
            detector_hwl=array(cars.detector_hwl),
            hwl_mean=array(prior.dimensions_mean_hwl),
            hwl_basis=array(prior.dimensions_basis_hwl),
            hwl_sigma=array(constant_like(self.config.dimensions_sigma_m, like)),
            detector_T_cam_obj=array(cars.detector_T_cam_obj),
            pose_sigma=array(pose_sigma),
            offset_sigma_px=array(no_offset if cars.offset_sigma_px is None else cars.offset_sigma_px[:, None]),
        )


def prior_terms(config: PriorConfig, prior: ShapePrior, cars: CarBatch) -> list[PriorTerm]:
    """Priors of shape, height, tilt, dimensions, pose where its sigma is known, and rig where an offset is unknown."""

    def of_shape(_: CarBatch, state: State) -> PriorResidual:
        return shape_prior(state.code)

    def of_dimensions(cars: CarBatch, state: State) -> PriorResidual:
        sigma = constant_like(config.dimensions_sigma_m, state.code)
        return dimensions_prior(prior.dimensions_and_derivative(state.code), cars.detector_hwl, sigma)

    def of_pose(cars: CarBatch, state: State) -> PriorResidual:
        sigma = detector_pose_sigma(config, cars)
        return pose_prior(state.T_obj_cam, cars.detector_T_cam_obj, sigma)

    def term(name: str, weight: float, residual_of: Callable[..., PriorResidual], num_rows: int, sees: str) -> CarPrior:
        return CarPrior(name, weight, cars, residual_of, num_rows, (sees,), config=config, prior=prior)

    tilt, num_tilts = (tilt_prior_normal, 2) if config.tilt_form == "normal" else (tilt_prior_cosine, 1)
    all_terms = [
        term("shape", config.shape_weight, of_shape, prior.num_codes, CODE),
        term("height", config.height_weight, height_prior, 1, POSE),
        term("tilt", config.tilt_weight, tilt, num_tilts, POSE),
        term("dimensions", config.dimensions_weight, of_dimensions, 3, CODE),
    ]
    if cars.detector_pose_sigma is not None or any(config.pose_sigmas):
        all_terms.append(term("pose", config.pose_weight, of_pose, 4, POSE))
    if cars.num_offsets:
        # This prior belongs to the measurements, because it limits how well the images measure a car.
        all_terms.append(replace(term("rig", RIG_WEIGHT, rig_prior, 1, OFFSET), is_prior=False))
    return [term for term in all_terms if term.weight > 0]


def with_joined_priors(terms: Sequence[AnyTerm]) -> tuple[AnyTerm, ...]:
    """The terms with the priors of `prior_terms` in one, because an iteration needs only their sum."""
    priors = [cast(CarPrior, term) for term in terms if set(term.names) <= set(PRIORS)]
    others = [term for term in terms if not set(term.names) <= set(PRIORS)]
    return (*others, _joined(priors)) if priors else tuple(others)


def _joined(terms: Sequence[CarPrior]) -> CarPrior:
    scales = tuple(math.sqrt(term.weight) for term in terms for _ in range(term.num_rows))

    def residual_of(cars: CarBatch, state: State) -> PriorResidual:
        at = [cast(PriorResidual, term.residual_of(cars, state)) for term in terms]
        residual = torch.cat([each.residual for each in at], dim=1)
        placed = [state.unknowns.placed(x.J_residual_state, term.sees) for x, term in zip(at, terms, strict=True)]
        scale = constant_like(scales, residual)
        return PriorResidual(residual * scale, torch.cat(placed, dim=1) * scale[:, None])

    joined, sees = {term.name: term.weight for term in terms}, (POSE, CODE)
    return replace(
        terms[0], name="priors", weight=1.0, residual_of=residual_of, num_rows=len(scales), sees=sees, joined=joined
    )


def detector_pose_sigma(config: PriorConfig, cars: CarBatch) -> Tensor:
    """Standard deviations (B, 4) of the input poses, see `Detections.pose_sigma`; infinite where they are unknown."""
    if cars.detector_pose_sigma is not None:
        return cars.detector_pose_sigma
    along_share, *constant = config.pose_sigmas
    origin = cars.detector_T_cam_obj[:, :3, 3]
    sigma = constant_like(tuple(s if s > 0 else math.inf for s in constant), origin).repeat(len(origin), 1)
    if along_share > 0:
        # This uses constant[0], because a constant of zero is infinite in `sigma`.
        distance = torch.hypot(origin[:, 0], origin[:, 2])
        sigma[:, 0] = torch.sqrt((along_share * distance) ** 2 + constant[0] ** 2)
    # The settings describe a detector, and no detector made these boxes.
    return sigma if cars.is_from_masks is None else sigma.masked_fill(cars.is_from_masks[:, None], math.inf)


def shape_prior(code: Tensor) -> PriorResidual:
    """This prior pulls the whitened code (B, K) to the mean shape (paper, E_shape; the basis includes sigma)."""
    num_cars, num_codes = code.shape
    identity = torch.eye(num_codes, dtype=code.dtype, device=code.device)
    return PriorResidual(code, identity.expand(num_cars, -1, -1))


def height_prior(cars: CarBatch, state: State) -> PriorResidual:
    """Measure the height of the object origin over the ground, along the camera's y axis (paper, r_trans), in metres.

    The residual is `r = (n . t + d) / n_y`, where t is the object origin in the camera frame and moves by
    `-R_cam_obj v`.
    """
    # With the translation p of T_obj_cam, `t = -R_cam_obj p`, so `n . t = -n_obj . p`.
    n_obj, n_y = _ground_normal_obj(cars, state), cars.ground_normal_cam[:, 1]
    residual = (cars.ground_offset - (n_obj * state.T_obj_cam[:, :3, 3]).sum(-1)) / n_y
    J_v = -n_obj / n_y[:, None]
    return PriorResidual(residual[:, None], pad(J_v, (0, 3))[:, None])


def tilt_prior_normal(cars: CarBatch, state: State) -> PriorResidual:
    """Return the horizontal components of the ground normal in the object frame, zero for a car that stands level.

    `n_obj = R_obj_cam n`, `r = (n_obj.x, n_obj.z)`. This Jacobian is nonzero at r = 0, unlike in the paper's form.
    """
    x, y, z = _ground_normal_obj(cars, state).unbind(-1)
    zero = torch.zeros_like(x)
    J_x, J_z = torch.stack([zero, z, -y], dim=-1), torch.stack([y, -x, zero], dim=-1)
    return PriorResidual(torch.stack([x, z], dim=-1), pad(torch.stack([J_x, J_z], dim=1), (3, 0)))


def tilt_prior_cosine(cars: CarBatch, state: State) -> PriorResidual:
    """The paper's `r_rot = 1 - (R_cam_obj [0, -1, 0]) . n = 1 + n_obj.y`; its Jacobian is zero where r is zero."""
    x, y, z = _ground_normal_obj(cars, state).unbind(-1)
    J_omega = torch.stack([-z, torch.zeros_like(x), x], dim=-1)[:, None]
    return PriorResidual((1 + y)[:, None], pad(J_omega, (3, 0)))


def _ground_normal_obj(cars: CarBatch, state: State) -> Tensor:
    return (state.T_obj_cam[:, :3, :3] * cars.ground_normal_cam[:, None]).sum(-1)


def dimensions_prior(
    shape: DimensionsDerivative,  # dimensions of B shapes
    detector_hwl: Tensor,  # (B, 3) metres
    sigma_hwl: Tensor,  # (3,) metres
) -> PriorResidual:
    """Compare the dimensions of the shape with the detector's, in the detector's standard deviations.

    The paper lacks this prior. A car seen from behind hides its length, which the detector's dimensions provide.
    """
    return PriorResidual((shape.hwl - detector_hwl) / sigma_hwl, shape.J_hwl_code / sigma_hwl[:, None])


def pose_prior(
    T_obj_cam: Tensor,  # (B, 4, 4)
    detector_T_cam_obj: Tensor,  # (B, 4, 4) input pose
    sigma: Tensor,  # (B, 4) along the viewing ray, across it, vertically (metres), heading (radians); infinite: unknown
) -> PriorResidual:
    """Compare the object origin and the heading with the detector's, in the detector's standard deviations.

    The paper lacks this prior. The axes belong to the detector's viewing ray, so they are fixed while the car moves.
    The heading is the angle about the camera's y axis from the detector's x axis to the car's x axis, in (-pi, pi].
    """
    T_cam_obj = se3.inverse(T_obj_cam)
    R_cam_obj, axes = T_cam_obj[:, :3, :3], viewing_axes(detector_T_cam_obj[:, :3, 3])
    moved = (axes @ (T_cam_obj[:, :3, 3:] - detector_T_cam_obj[:, :3, 3:]))[..., 0]
    x_axis, x_detector = R_cam_obj[:, 0::2, 0], detector_T_cam_obj[:, 0::2, 0]
    sine = x_axis[:, 0] * x_detector[:, 1] - x_axis[:, 1] * x_detector[:, 0]
    turned = torch.atan2(sine, (x_axis * x_detector).sum(-1))
    J = T_obj_cam.new_zeros(len(T_obj_cam), 4, 6)
    J[:, :3, :3] = -axes @ R_cam_obj
    J[:, 3, 3:6] = J_heading_omega(R_cam_obj)
    return PriorResidual(torch.cat([moved, turned[:, None]], dim=-1) / sigma, J / sigma[..., None])


def J_heading_omega(R_obj: Tensor) -> Tensor:
    """Return the derivative (B, 3) by omega of the heading `atan2(-h_z, h_x)`; h is the x axis of a car in `R_obj`.

    h moves by R (e_x x omega) = omega_y R[:, 2] - omega_z R[:, 1], and its angle by (h_z dh_x - h_x dh_z) / |h|^2.
    """
    x_axis, dh_y, dh_z = R_obj[:, 0::2, 0], R_obj[:, 0::2, 2], -R_obj[:, 0::2, 1]
    by_y, by_z = (x_axis[:, 1] * dh[:, 0] - x_axis[:, 0] * dh[:, 1] for dh in (dh_y, dh_z))
    return torch.stack([torch.zeros_like(by_y), by_y, by_z], dim=-1) / (x_axis * x_axis).sum(-1, keepdim=True)


def rig_prior(cars: CarBatch, state: State) -> PriorResidual:
    """Offset of the disparity in standard deviations; for a car without a sigma, in pixels, where it stays 0."""
    assert cars.offset_sigma_px is not None
    sigma = torch.where(cars.offset_sigma_px > 0, cars.offset_sigma_px, 1.0)[:, None]
    return PriorResidual(state.offset_px / sigma, (1 / sigma)[:, None])
