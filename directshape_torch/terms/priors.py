"""Priors, `lambda r^2 / 2`: shape code, height above the ground, tilt against it, the detector's box, the rig.

Each residual is a function of the cars and a state that returns it with its Jacobian by the unknowns that it sees; a
prior of one's own is such a function in a `PriorTerm` (docs/extra_terms.md). Derivations: docs/derivations/priors.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import PriorConfig
from directshape_torch.errors import InputError, shown
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import viewing_axes
from directshape_torch.numerics.checks import check_alike, check_shape
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.rows import Blocks
from directshape_torch.shape.field import Field
from directshape_torch.shape.shape_prior import DimensionsDerivative, ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, State
from directshape_torch.terms import robust
from directshape_torch.terms.term import Linear, Term, Where

RIG_WEIGHT = 0.2
"""Of the offset of the disparity, in its standard deviations: that of the detector's pose, with which it is weighed."""


class PriorResidual(NamedTuple):
    """Residual of a prior for B cars, with its Jacobian."""

    residual: Tensor  # (B, R)
    J_residual_state: Tensor  # (B, R, S) by the unknowns that the term sees, block after block


@dataclass(frozen=True)
class PriorTerm(Term):
    """`weight * sum_i r_i^2 / 2` of a residual of the state alone: one block of R rows for each car.

    Raises:
        InputError: the weight is no number; a value is no tensor with a row for each detection of the call, or has
            another device or, in floating point, another dtype than the cars.
    """

    name: str  # of the term
    weight: float  # lambda
    cars: CarBatch  # constants of the cars
    # The residual with its Jacobian, or the residual (B, R) alone, which is then differentiated automatically; from the
    # constants, a state and, by name, the rows (B, ...) of the values.
    residual_of: Callable[..., PriorResidual | Tensor]
    num_rows: int  # R
    sees: tuple[str, ...] = (POSE, CODE)  # the blocks of unknowns of its Jacobian
    is_prior: bool = True  # False for what belongs to the measurements
    # What else the residual needs to know of each car: tensors (N, ...) of all N detections of the call.
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
        """What `residual_of` says of a state, from the rows of the cars that are left."""
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

    def _derived(self, state: State) -> PriorResidual:
        """The residual with its Jacobian by all unknowns, from forward-mode differentiation."""
        unknowns = state.unknowns

        def residual(delta: Tensor) -> tuple[Tensor, Tensor]:
            at = self._at(unknowns.retract(state, delta.expand(len(state.code), unknowns.size)))
            assert isinstance(at, Tensor)
            return at, at

        zero = torch.zeros(unknowns.size, dtype=state.code.dtype, device=state.code.device)
        J, value = torch.func.jacfwd(residual, has_aux=True)(zero)
        return PriorResidual(value, J)

    def linear(self, field: Field, state: State, where: Where) -> Linear:
        at = self._at(state)
        at = self._derived(state) if isinstance(at, Tensor) else at
        residual = at.residual.to(torch.float64)[..., None]
        return Linear(residual, torch.ones_like(residual), at.J_residual_state.to(torch.float64), where)

    def residual(self, field: Field, state: State, where: Where) -> Tensor:
        at = self._at(state)
        return (at if isinstance(at, Tensor) else at.residual).to(torch.float64)[..., None]

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.quadratic(residual)

    def of_cars(self, keep: Tensor, numbers: Sequence[int]) -> PriorTerm:
        return replace(self, cars=self.cars.of_cars(keep, numbers))


def prior_terms(config: PriorConfig, prior: ShapePrior, cars: CarBatch) -> list[PriorTerm]:
    """Shape, height, tilt, dimensions, pose where its sigma is known, and the rig where its disparity is not."""

    def of_shape(_: CarBatch, state: State) -> PriorResidual:
        return shape_prior(state.code)

    def of_dimensions(cars: CarBatch, state: State) -> PriorResidual:
        sigma = constant_like(config.dimensions_sigma_m, state.code)
        return dimensions_prior(prior.dimensions_and_derivative(state.code), cars.detector_hwl, sigma)

    def of_pose(cars: CarBatch, state: State) -> PriorResidual:
        sigma = detector_pose_sigma(config, cars)
        return pose_prior(state.T_obj_cam, cars.detector_T_cam_obj, sigma)

    tilt, num_tilts = (tilt_prior_normal, 2) if config.tilt_form == "normal" else (tilt_prior_cosine, 1)
    all_terms = [
        PriorTerm("shape", config.shape_weight, cars, of_shape, prior.num_codes, (CODE,)),
        PriorTerm("height", config.height_weight, cars, height_prior, 1, (POSE,)),
        PriorTerm("tilt", config.tilt_weight, cars, tilt, num_tilts, (POSE,)),
        PriorTerm("dimensions", config.dimensions_weight, cars, of_dimensions, 3, (CODE,)),
    ]
    if cars.detector_pose_sigma is not None or any(config.pose_sigmas):
        all_terms.append(PriorTerm("pose", config.pose_weight, cars, of_pose, 4, (POSE,)))
    if cars.num_offsets:
        # How well a disparity is measured: what the images say of a car holds no more than that.
        all_terms.append(PriorTerm("rig", RIG_WEIGHT, cars, rig_prior, 1, (OFFSET,), is_prior=False))
    return [term for term in all_terms if term.weight > 0]


def joined(terms: Sequence[PriorTerm]) -> PriorTerm:
    """One term that costs what priors of pose and shape do together: an iteration asks for the sum alone."""

    def residual_of(cars: CarBatch, state: State) -> PriorResidual:
        unknowns = state.unknowns.only(POSE, CODE)
        scaled = []
        for term in terms:
            at = term.residual_of(cars, state)
            assert isinstance(at, PriorResidual)  # as ours are
            J = unknowns.placed(at.J_residual_state, term.sees)
            scaled.append([math.sqrt(term.weight) * x for x in (at.residual, J)])
        return PriorResidual(*(torch.cat(parts, dim=1) for parts in zip(*scaled, strict=True)))

    return PriorTerm("priors", 1.0, terms[0].cars, residual_of, sum(term.num_rows for term in terms))


def detector_pose_sigma(config: PriorConfig, cars: CarBatch) -> Tensor:
    """Standard deviations (B, 4) of the input poses, see `Detections.pose_sigma`; infinite where nobody knows them."""
    if cars.detector_pose_sigma is not None:
        return cars.detector_pose_sigma
    along_share, *constant = config.pose_sigmas
    origin = cars.detector_T_cam_obj[:, :3, 3]
    sigma = constant_like(tuple(s if s > 0 else math.inf for s in constant), origin).repeat(len(origin), 1)
    if along_share > 0:
        # constant[0], for infinity stands for nothing known here.
        distance = torch.hypot(origin[:, 0], origin[:, 2])
        sigma[:, 0] = torch.sqrt((along_share * distance) ** 2 + constant[0] ** 2)
    return sigma


def shape_prior(code: Tensor) -> PriorResidual:
    """Pulls the whitened code (B, K) to the mean shape (paper, E_shape; sigma is folded into the basis)."""
    num_cars, num_codes = code.shape
    identity = torch.eye(num_codes, dtype=code.dtype, device=code.device)
    return PriorResidual(code, identity.expand(num_cars, -1, -1))


def height_prior(cars: CarBatch, state: State) -> PriorResidual:
    """Height of the object origin against the ground plane, along the camera's y axis (paper, r_trans), metres.

    `r = (n . t + d) / n_y` with t the object origin in the camera frame, which moves by `-R_cam_obj v`.
    """
    # With `t = -R_cam_obj p`, p the translation of T_obj_cam, `n . t = -n_obj . p`.
    n_obj, n_y = _ground_normal_obj(cars, state), cars.ground_normal_cam[:, 1]
    residual = (cars.ground_offset - (n_obj * state.T_obj_cam[:, :3, 3]).sum(-1)) / n_y
    J_v = -n_obj / n_y[:, None]
    return PriorResidual(residual[:, None], torch.nn.functional.pad(J_v, (0, 3))[:, None])


def tilt_prior_normal(cars: CarBatch, state: State) -> PriorResidual:
    """Horizontal components of the ground normal in the object frame: zero for a car that stands on the ground.

    `n_obj = R_obj_cam n`, `r = (n_obj.x, n_obj.z)`; unlike the paper's form its Jacobian does not vanish at zero.
    """
    x, y, z = _ground_normal_obj(cars, state).unbind(-1)
    zero = torch.zeros_like(x)
    J_x, J_z = torch.stack([zero, z, -y], dim=-1), torch.stack([y, -x, zero], dim=-1)
    return PriorResidual(torch.stack([x, z], dim=-1), _by_rotation(torch.stack([J_x, J_z], dim=1)))


def tilt_prior_cosine(cars: CarBatch, state: State) -> PriorResidual:
    """The paper's `r_rot = 1 - (R_cam_obj [0, -1, 0]) . n = 1 + n_obj.y`; its Jacobian vanishes where r does."""
    x, y, z = _ground_normal_obj(cars, state).unbind(-1)
    J_omega = torch.stack([-z, torch.zeros_like(x), x], dim=-1)[:, None]
    return PriorResidual((1 + y)[:, None], _by_rotation(J_omega))


def _ground_normal_obj(cars: CarBatch, state: State) -> Tensor:
    return (state.T_obj_cam[:, :3, :3] * cars.ground_normal_cam[:, None]).sum(-1)


def _by_rotation(J_omega: Tensor) -> Tensor:
    """Jacobian by the pose of a residual that only rotation changes, from its part (B, R, 3)."""
    return torch.nn.functional.pad(J_omega, (3, 0))


def dimensions_prior(
    shape: DimensionsDerivative,  # of B shapes
    detector_hwl: Tensor,  # (B, 3) metres
    sigma_hwl: Tensor,  # (3,) metres
) -> PriorResidual:
    """Shape dimensions against the detector's, in the detector's standard deviations.

    A car seen from behind does not show its length: the detector's dimensions are information (not in the paper).
    """
    return PriorResidual((shape.hwl - detector_hwl) / sigma_hwl, shape.J_hwl_code / sigma_hwl[:, None])


def pose_prior(
    T_obj_cam: Tensor,  # (B, 4, 4)
    detector_T_cam_obj: Tensor,  # (B, 4, 4) input pose
    sigma: Tensor,  # (B, 4) along the viewing ray, across it, vertically (metres), heading (radians); infinite: no part
) -> PriorResidual:
    """Object origin and heading against the detector's, in the detector's standard deviations (not in the paper).

    The axes are those of the detector's viewing ray, so they stay while the car moves; the heading is the angle about
    the camera's y axis from the detector's x axis to the car's, in (-pi, pi].
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
    """Derivative (B, 3) of the heading `atan2(-h_z, h_x)` of cars of rotation (B, 3, 3) by omega; h is their x axis.

    It moves by R (e_x x omega) = omega_y R[:, 2] - omega_z R[:, 1], its angle by (h_z dh_x - h_x dh_z) / |h|^2.
    """
    x_axis, dh_y, dh_z = R_obj[:, 0::2, 0], R_obj[:, 0::2, 2], -R_obj[:, 0::2, 1]
    by_y, by_z = (x_axis[:, 1] * dh[:, 0] - x_axis[:, 0] * dh[:, 1] for dh in (dh_y, dh_z))
    return torch.stack([torch.zeros_like(by_y), by_y, by_z], dim=-1) / (x_axis * x_axis).sum(-1, keepdim=True)


def rig_prior(cars: CarBatch, state: State) -> PriorResidual:
    """Offset of the disparity in its standard deviations; pixels for a car that has none, whose offset stays 0."""
    assert cars.offset_sigma_px is not None
    sigma = torch.where(cars.offset_sigma_px > 0, cars.offset_sigma_px, 1.0)[:, None]
    return PriorResidual(state.offset_px / sigma, (1 / sigma)[:, None])
