"""What every term of the energy is, and the one function that sums terms into cost, gradient and matrices.

A row of a term sees the state of its car through one scalar, `inner`: the signed distance at the closest point of a
ray, the depth of the surface under a pixel (which all its neighbours share), or the residual itself. So a term gives
factors, and its Jacobian is never kept: `J_residual_state = J_residual_inner J_inner_state`.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn, Protocol, Self, TypeAlias

import torch
from torch import Tensor

from directshape_torch.compile import compilable, will_compile, with_varying
from directshape_torch.config import StageConfig
from directshape_torch.rows import Blocks, CarSums
from directshape_torch.shape.field import Field, field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.unknowns import CODE, POSE, State
from directshape_torch.terms.depth import Closest, Hits
from directshape_torch.terms.robust import RobustValue

Where: TypeAlias = Any
"""Where the rows of a term look: a tensor (..., M, R) or a named tuple of such, constants; `()` for nowhere."""


class Sight(NamedTuple):
    """What the rays of all pixels see at a state where nothing was known before: constants."""

    state: State
    field: Field
    closest: Closest  # of the rays of both images, left ones first
    hits: Hits  # of the rays of the left image


class Linear(NamedTuple):
    """Residuals of a term with their Jacobian in factors, N residuals to a row."""

    residual: Tensor  # (M, R, N)
    J_residual_inner: Tensor  # (M, R, N)
    # (M, R, S) by the unknowns that the term sees, block after block, or (M, R, D) by all
    J_inner_state: Tensor
    where: Where  # the points at which they were taken


class Evidence(Protocol):
    """What is known of B cars before the first stage, of which each stage makes a term. It never changes."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the C columns of costs that its terms fill."""
        ...

    def begin(self, stage: StageConfig, sight: Sight) -> Term:
        """The term of a stage, with everything fixed that must not change meanwhile: pixel sets, counts, widths."""
        ...

    def of_cars(self, keep: Tensor, numbers: Sequence[int]) -> Self:
        """The evidence of the cars where `keep` (B,) holds: `numbers` of them, as the host knows it."""
        ...


class _FieldAlone:
    """A name without a value on the class: that of each object counts."""

    def __get__(self, term: object, kind: type) -> NoReturn:
        raise AttributeError(f"{kind.__name__} object has no value of this field")


class Term(Protocol):
    """One summand of the energy of B cars in a stage. Terms never change.

    A term whose rows are the same in all stages is its own `Evidence`.
    A subclass need not write what is here: a measurement of one column, whose rows are the same in all stages, may all
    change, and look nowhere. Fields of a dataclass may stand for properties.
    """

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # A dataclass takes what it inherits under the name of a field for its default, and could not set a property.
        for name in inspect.get_annotations(cls).keys() & vars(Term).keys():
            if inspect.getattr_static(cls, name) is vars(Term)[name]:
                setattr(cls, name, _FieldAlone())

    @property
    def names(self) -> tuple[str, ...]:
        """Of the C columns of costs that it fills."""
        ...

    @property
    def sees(self) -> tuple[str, ...]:
        """The blocks of unknowns by which its Jacobian is given, in their order (`state.unknowns`)."""
        return POSE, CODE

    @property
    def is_prior(self) -> bool:
        """Whether it says what is known beforehand, and not what was measured."""
        return False

    @property
    def blocks(self) -> Blocks:
        """M blocks of R rows."""
        ...

    @property
    def column(self) -> Tensor:
        """Which (M,) of the names each block belongs to."""
        return torch.zeros_like(self.blocks.owner)

    @property
    def block_weight(self) -> Tensor:
        """Factor (M,) of the rows of each block, float64."""
        ...

    @property
    def information(self) -> Tensor:
        """The same (M,) in the Fisher matrix, float64: residuals in standard deviations, not means."""
        ...

    @property
    def row_weight(self) -> Tensor:
        """Of single residuals (M, R, N); zero in empty places."""
        ...

    def begin(self, stage: StageConfig, sight: Sight) -> Term:
        """The term of a stage, which for rows that are the same in all stages is the term itself."""
        return self

    def moving(self, sight: Sight, after_wider: bool) -> tuple[Self, Where, Tensor]:
        """The rows that can change while the stage's iterations move the cars, where they look, and the others' cost
        (B, C) in the columns of the term.

        `after_wider`: an earlier stage had a wider contour, so that this one has less to move.
        """
        by_car = len(self.blocks.counts), len(self.names)
        return self, self.where(sight), torch.zeros(by_car, dtype=torch.float64, device=self.blocks.owner.device)

    def where(self, sight: Sight) -> Where:
        """Where the rows look at a state at which every ray was marched."""
        return ()

    def linear(self, field: Field, state: State, where: Where) -> Linear:
        """Residuals with their hand-derived Jacobian, looking near `where`, which is that of a state nearby.

        A user's term may do without it: `terms.derived` then differentiates its `residual`.
        With gradients enabled all of it is differentiable, by the state and by whatever the term is made of.
        """
        ...

    def residual(self, field: Field, state: State, where: Where) -> Tensor:
        """Residuals (M, R, N) by themselves, of states next to the one whose `linear` gave `where`; differentiable."""
        ...

    def norm(self, residual: Tensor) -> RobustValue:
        """What residuals (M, R, N) cost."""
        ...

    def of_cars(self, keep: Tensor, numbers: Sequence[int]) -> Self:
        """The rows of the cars where `keep` (B,) holds: `numbers` of them, as the host knows it."""
        ...


class Part(NamedTuple):
    """What the M blocks of a term add to the sums of their cars, float64 and not yet weighted."""

    cost: Tensor  # (M,)
    products: Tensor  # (M, D + 1, D) the Gauss-Newton matrix and, as one more row, the gradient
    information: Tensor  # (M, D, D) the matrix with the weights of the Fisher information; without `fisher` the other
    residual: Tensor  # (M, R, N)
    where: Where  # the points at which they were taken


def linear_of(term: Term, field: Field, state: State, where: Where) -> Linear:
    """`term.linear` with a column for each unknown of the state, zeros by those that the term does not see."""
    at = term.linear(field, state, where)
    return at._replace(J_inner_state=state.unknowns.placed(at.J_inner_state, term.sees))


def part_of(term: Term, at: Linear, fisher: bool = True) -> Part:
    """The sums over the rows of each block, from residuals and their Jacobian in factors.

    Without `fisher` nobody asks for the information, and the Gauss-Newton matrix stands in its place.
    """
    norm = term.norm(at.residual)
    weight = term.row_weight
    # All residuals of a row share one inner scalar, so their Jacobians are multiples of one: sum the multiples first.
    J, squared = at.J_residual_inner, at.J_residual_inner * at.J_residual_inner
    first = (weight * norm.gradient_weight * J).sum(dim=-1)
    second = (weight * norm.hessian_weight * squared).sum(dim=-1)
    products = weighted_products(at.J_inner_state, first, second)
    information = products[:, :-1]
    if fisher and norm.information_weight is not norm.hessian_weight:
        third = (weight * norm.information_weight * squared).sum(dim=-1)
        information = weighted_products(at.J_inner_state, first, third)[:, :-1]
    return Part(_block_costs(weight, norm), products, information, at.residual, at.where)


def part_of_rows(term: Term, residual: Tensor, J: Tensor, where: Where) -> Part:
    """The same from residuals (M, R, N) and any Jacobian (M, R, N, D) of them."""
    norm, weight = term.norm(residual), term.row_weight
    first, second = (weight * w for w in (norm.gradient_weight, norm.hessian_weight))
    products = weighted_products(J.flatten(1, 2), first.flatten(1, 2), second.flatten(1, 2))
    return Part(_block_costs(weight, norm), products, products[:, :-1], residual, where)


def _block_costs(weight: Tensor, norm: RobustValue) -> Tensor:
    return (weight * norm.rho).sum(dim=-1).to(torch.float64).sum(dim=1)


# The sizes that vary from call to call, of the state, of the shapes, and of where rows look.
_SIZES = {
    "T_obj_cam": 0,
    "code": 0,
    "offset_px": 0,
    "path": 0,
    "T_obj_next": 0,
    "values": 0,
    "points_obj": 1,
    "normal_obj": 1,
    "face_obj": 1,
    "depth": 0,
    "depths": 1,
    "crosses": 0,
    "on_surface": 0,
    "usable": 0,
}


def with_varying_blocks(term: Term) -> Term:
    """The term with its number of blocks marked as what varies, for compiled code to hold for any; else as it is."""
    if not will_compile():
        return term
    num_blocks = len(term.blocks.owner)

    def axes_of(tensor: Tensor) -> set[int]:
        # Tables of one or two axes grow along the first, so do those of cars; what is in blocks along the last but one.
        is_in_blocks = tensor.ndim > 2 and tensor.shape[-2] == num_blocks
        return {tensor.ndim - 2 if is_in_blocks else 0} if tensor.ndim else set()

    return with_varying(term, axes_of)


@compilable(sizes=_SIZES)
def parts_of(
    terms: tuple[Term, ...], field: Field, state: State, wheres: tuple[Where, ...], fisher: bool = True
) -> tuple[Part, ...]:
    """All terms at a state, looking near the points given, with their hand-derived Jacobians."""
    ats = [linear_of(term, field, state, where) for term, where in zip(terms, wheres, strict=True)]
    return tuple(part_of(term, at, fisher) for term, at in zip(terms, ats, strict=True))


def weighted_products(
    J: Tensor,  # (M, R, D)
    gradient_weight: Tensor,  # (M, R)
    hessian_weight: Tensor,  # (M, R)
) -> Tensor:  # (M, D + 1, D)
    """`sum w_H J^T J` of each block and, as one more row, `sum w_g J`; float64.

    The rows of a block are summed in their own precision, the blocks of a car in float64.
    """
    weighted = torch.cat([J * hessian_weight[..., None], gradient_weight[..., None]], dim=-1)
    return torch.bmm(weighted.mT, J).to(torch.float64)


class Evaluation(NamedTuple):
    """The energy of B cars at one state, float64, and where its rows looked."""

    cost: Tensor  # (B,)
    gradient: Tensor  # (B, D)
    hessian: Tensor  # (B, D, D) Gauss-Newton matrix
    wheres: tuple[Where, ...]  # of each term


class Figures(NamedTuple):
    """The energy of B cars at one state, column by column of the T columns of its terms, float64."""

    term_costs: Tensor  # (B, T)
    gradient: Tensor  # (B, T, D)
    hessian: Tensor  # (B, T, D, D)
    information: Tensor  # (B, T, D, D) Fisher matrix, up to one calibration factor
    parts: tuple[Part, ...]  # of each term

    @property
    def cost(self) -> Tensor:
        """Of all terms (B,)."""
        return self.term_costs.sum(dim=1)


def summed(sums: CarSums, weight: Tensor, parts: Sequence[Part]) -> Evaluation:
    """The evaluation that the blocks of all terms add up to, with weights (M,) of the blocks of all terms."""
    products = sums.sum(torch.cat([part.products for part in parts]), weight)
    cost = sums.sum(torch.cat([part.cost for part in parts]), weight)
    return Evaluation(cost, products[:, -1], products[:, :-1], tuple(part.where for part in parts))


def by_autograd(
    terms: Sequence[Term], prior: ShapePrior, state: State, wheres: Sequence[Where]
) -> list[tuple[Tensor, Tensor]]:
    """Residuals (M, R, N) of every term and their Jacobian (M, R, N, D) by forward-mode differentiation.

    Each residual depends on one car only, so one tangent of `retract` moves all cars at once: D tangents, batched,
    share one evaluation of the values. Where the rows look is a constant, as in the hand-derived form.
    """

    unknowns = state.unknowns

    def residuals(delta: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        moved = unknowns.retract(state, delta.expand(len(state.code), unknowns.size))
        field = field_of(prior.bind(moved.code))
        of_terms = [term.residual(field, moved, where) for term, where in zip(terms, wheres, strict=True)]
        return of_terms, of_terms

    zero = torch.zeros(unknowns.size, dtype=state.code.dtype, device=state.code.device)
    jacobians, values = torch.func.jacfwd(residuals, has_aux=True)(zero)
    return list(zip(values, jacobians, strict=True))
