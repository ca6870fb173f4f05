"""This module defines a term of the energy and sums terms into cost, gradient and matrices.

A row of a term depends on the state of its car through one scalar, `inner`: the signed distance at the closest point of
a ray, the depth of the surface under a pixel (which all neighbours of the pixel share), or the residual itself. A term
therefore gives its Jacobian only in factors: `J_residual_state = J_residual_inner J_inner_state`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, NoReturn, Protocol, Self, TypeAlias, TypeVar

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.config import StageConfig
from directshape_torch.errors import InputError
from directshape_torch.kernels.arguments import Columns, Sums, Turn
from directshape_torch.kernels.choice import array, every_turn
from directshape_torch.numerics.tables import Table
from directshape_torch.rows import Blocks, CarSums
from directshape_torch.shape.field import Field, field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, State, Unknowns
from directshape_torch.terms.depth import Closest, Hits
from directshape_torch.terms.robust import RobustValue

# The anchor of a term is constant: a tensor (..., M, R), a named tuple of these, or `NoAnchor`.
AnchorT = TypeVar("AnchorT", bound=Tensor | tuple[Tensor, ...])
NoAnchor: TypeAlias = tuple[()]


class Prepared(NamedTuple):
    """A `Prepared` is a state with what the rays of all pixels hit there, whatever other states are; it is constant."""

    state: State
    field: Field
    closest: Closest  # closest points of the rays of both images, left ones first
    hits: Hits  # hits of the rays of the left image


class Linear(NamedTuple, Generic[AnchorT]):
    """A `Linear` holds residuals of a term, N for each row, with their Jacobian in factors."""

    residual: Tensor  # (M, R, N)
    J_residual_inner: Tensor  # (M, R, N)
    # (M, R, S) by the unknowns that the term sees, block after block, or (M, R, D) by all unknowns
    J_inner_state: Tensor
    anchor: AnchorT  # the points at which the residuals were taken


class Evidence(Table, Protocol):
    """`Evidence` is what is known of B cars before the first stage; each stage makes a term of it. It never changes."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the C columns of costs that the terms of this evidence fill."""
        ...

    def begin(self, stage: StageConfig, prepared: Prepared) -> AnyTerm:
        """The term of a stage, with fixed pixel sets, counts and widths."""
        ...


class _FieldAlone:
    """`_FieldAlone` marks a name that has a value on each object but none on the class."""

    def __get__(self, term: object, kind: type) -> NoReturn:
        raise AttributeError(f"{kind.__name__} object has no value of this field")


class Term(Table, Protocol[AnchorT]):
    """A `Term` is one summand of the energy of B cars in a stage. Terms never change.

    A term whose rows are equal in all stages is its own `Evidence`. The defaults suit a measurement with one column of
    costs, whose rows are equal in all stages, can all change, and have no anchor; its class need not override them.
    Fields of a dataclass may replace properties.
    """

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # A dataclass would use an inherited property as the default of its field, and could not set the property.
        for name in inspect.get_annotations(cls).keys() & vars(Term).keys():
            if inspect.getattr_static(cls, name) is vars(Term)[name]:
                setattr(cls, name, _FieldAlone())

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the C columns of costs that the term fills."""
        ...

    @property
    def sees(self) -> tuple[str, ...]:
        """The blocks of unknowns by which its Jacobian is given, in their order (`state.unknowns`)."""
        return POSE, CODE

    @property
    def is_prior(self) -> bool:
        """Whether the term is prior knowledge and not a measurement."""
        return False

    @property
    def blocks(self) -> Blocks:
        """M blocks of R rows."""
        ...

    @property
    def column(self) -> Tensor:
        """Index (M,) into the names of the column of each block."""
        return torch.zeros_like(self.blocks.owner)

    @property
    def block_weight(self) -> Tensor:
        """Factor (M,) of the rows of each block, float64."""
        ...

    @property
    def information(self) -> Tensor:
        """Factor (M,) of each block in the Fisher matrix, float64; it counts standard deviations instead of means."""
        ...

    @property
    def row_weight(self) -> Tensor:
        """Weights (M, R, N) of single residuals; zero in empty places."""
        ...

    def begin(self, stage: StageConfig, prepared: Prepared) -> AnyTerm:
        """The term of a stage; it is the term itself if the rows are equal in all stages."""
        return self

    def changing_rows(self, prepared: Prepared, after_wider: bool) -> tuple[Self, AnchorT, Tensor]:
        """Return the rows that can change during the iterations of a stage, their anchor, and the cost of the rest.

        The cost (B, C) of all other rows is in the columns of the term. If `after_wider` is true, an earlier stage had
        a wider contour, so that less motion remains.
        """
        by_car = len(self.blocks.counts), len(self.names)
        return self, self.anchor(prepared), torch.zeros(by_car, dtype=torch.float64, device=self.blocks.owner.device)

    def anchor(self, prepared: Prepared) -> AnchorT:
        """The anchor at a prepared state: constants, such as points on marched rays, near which rows are evaluated."""
        return ()  # type: ignore[return-value]  # a term with an anchor has its own method

    def linear(self, field: Field, state: State, anchor: AnchorT) -> Linear[AnchorT]:
        """Return residuals with their hand-derived Jacobian; rows are evaluated near `anchor`, of a nearby state.

        A user's term may omit this method: `linear_of` then differentiates its `residual`. With gradients enabled the
        result is differentiable by the state and by all tensors of the term.
        """
        ...

    def native_loop(
        self, field: Field, state: State, anchor: AnchorT, fisher: bool, turn: Turn
    ) -> NativeLoop[AnchorT] | None:
        """A loop that does what `part_of` does for the cars whose `turn` it is; None where there is none."""
        return None

    def native_part(self, field: Field, state: State, anchor: AnchorT, fisher: bool) -> Part[AnchorT] | None:
        """What `part_of` gives, by a native loop; None where none is taken."""
        loop = self.native_loop(field, state, anchor, fisher, every_turn(len(state.code)))
        return None if loop is None else loop.run()

    def residual(self, field: Field, state: State, anchor: AnchorT) -> Tensor:
        """Differentiable residuals (M, R, N) at a state close to the one whose `linear` gave `anchor`."""
        ...

    def norm(self, residual: Tensor) -> RobustValue:
        """The norm of residuals (M, R, N), with its weights."""
        ...


AnyTerm: TypeAlias = Term[Any]
"""The terms of a sum have anchors of different kinds."""


class Part(NamedTuple, Generic[AnchorT]):
    """A `Part` is what the M blocks of a term add to the sums of their cars, before weighting, float64."""

    cost: Tensor  # (M,)
    products: Tensor  # (M, D + 1, D) the Gauss-Newton matrix and, as the last row, the gradient
    information: Tensor  # (M, D, D) the Fisher matrix, or without `fisher` the Gauss-Newton matrix
    residual: Tensor  # (M, R, N)
    anchor: AnchorT  # the points at which the residuals were taken


class NativeLoop(NamedTuple, Generic[AnchorT]):
    """A `NativeLoop` reads the numbers that its tensors have when it runs, and writes them into one part each time."""

    loop: Callable[[], None]
    part: Part[AnchorT]

    def run(self) -> Part[AnchorT]:
        self.loop()
        return self.part


def native_columns(unknowns: Unknowns) -> Columns:
    """Where the blocks of a car begin, for native loops."""
    return Columns(*(unknowns.span(name).start for name in (POSE, CODE, OFFSET)))


def part_to_write(
    term: Term[AnchorT], state: State, anchor: AnchorT, shape: tuple[int, int, int], own_information: bool
) -> tuple[Part[AnchorT], Sums]:
    """A part with residuals of a shape (M, R, N), and where a native loop writes it, block by block.

    Without `own_information` the Gauss-Newton matrix is the Fisher matrix too.
    """
    size = state.unknowns.size
    products = state.code.new_zeros(shape[0], size + 1, size, dtype=torch.float64)
    cost, residual = products.new_empty(shape[0]), state.code.new_empty(shape)
    seen = state.unknowns.span(*term.sees)
    information = torch.zeros_like(products[:, :-1]) if own_information else products[:, :-1]
    part = Part(cost, products, information, residual, anchor)
    into = information if own_information else information[:, :0, :0]
    return part, Sums(seen.start, seen.stop - seen.start, *map(array, (cost, products, into, residual)))


def linear_of(term: Term[AnchorT], prior: ShapePrior, field: Field, state: State, anchor: AnchorT) -> Linear[AnchorT]:
    """`term.linear` with a column for each unknown of the state; columns of unseen unknowns are zero.

    Where a term has none its `residual` is differentiated, which is slow.

    Raises:
        InputError: a term without `linear` has several residuals a row.
    """
    if has_linear(term):
        return in_all_columns(term, state, term.linear(field, state, anchor))
    ((residual, J),) = by_autograd([term], prior, state, [anchor])
    if residual.shape[-1:] != (1,):
        cure = "write linear(...) by hand, which may give several residuals of a row one inner scalar"
        called = f"extra term {term.names[0]!r}: residual(...)"
        raise InputError(called, "one residual a row, shape (M, R, 1)", f"{tuple(residual.shape)}", cure)
    return Linear(residual, torch.ones_like(residual), J[:, :, 0], anchor)


def has_linear(term: AnyTerm) -> bool:
    """Whether a term has a `linear` of its own."""
    return inspect.getattr_static(term, "linear") is not vars(Term)["linear"]


def in_all_columns(term: Term[AnchorT], state: State, at: Linear[AnchorT]) -> Linear[AnchorT]:
    """What a term's own `linear` gives, with a column for each unknown of the state."""
    return at._replace(J_inner_state=state.unknowns.placed(at.J_inner_state, term.sees))


def part_of(term: Term[AnchorT], at: Linear[AnchorT], fisher: bool = True) -> Part[AnchorT]:
    """Sum over the rows of each block, from residuals and their Jacobian in factors.

    Without `fisher` the information is unused, and the Gauss-Newton matrix takes its place.
    """
    norm = term.norm(at.residual)
    weight = term.row_weight
    # All residuals of a row share one inner scalar, so their Jacobians are multiples of one; the multiples are added.
    J, squared = at.J_residual_inner, at.J_residual_inner * at.J_residual_inner
    first = (weight * norm.gradient_weight * J).sum(dim=-1)
    second = (weight * norm.hessian_weight * squared).sum(dim=-1)
    products = weighted_products(at.J_inner_state, first, second)
    information = products[:, :-1]
    if fisher and norm.information_weight is not norm.hessian_weight:
        third = (weight * norm.information_weight * squared).sum(dim=-1)
        information = weighted_products(at.J_inner_state, first, third)[:, :-1]
    return Part(_block_costs(weight, norm), products, information, at.residual, at.anchor)


def part_of_rows(term: Term[AnchorT], residual: Tensor, J: Tensor, anchor: AnchorT) -> Part[AnchorT]:
    """Sums over the rows of each block, from residuals (M, R, N) and any Jacobian (M, R, N, D) of them."""
    norm, weight = term.norm(residual), term.row_weight
    first, second = (weight * w for w in (norm.gradient_weight, norm.hessian_weight))
    products = weighted_products(J.flatten(1, 2), first.flatten(1, 2), second.flatten(1, 2))
    return Part(_block_costs(weight, norm), products, products[:, :-1], residual, anchor)


def _block_costs(weight: Tensor, norm: RobustValue) -> Tensor:
    return (weight * norm.rho).sum(dim=-1).to(torch.float64).sum(dim=1)


def parts_of(
    terms: tuple[AnyTerm, ...], field: Field, state: State, anchors: tuple[object, ...], fisher: bool = True
) -> tuple[Part[Any], ...]:
    """The parts of all terms at a state, with hand-derived Jacobians, near their anchors."""
    native = [term.native_part(field, state, at, fisher) for term, at in zip(terms, anchors, strict=True)]
    rest = [n for n, part in enumerate(native) if part is None]
    others = iter(_parts_of(tuple(terms[n] for n in rest), field, state, tuple(anchors[n] for n in rest), fisher))
    return tuple(part or next(others) for part in native)


@compilable
def _parts_of(
    terms: tuple[AnyTerm, ...], field: Field, state: State, anchors: tuple[object, ...], fisher: bool
) -> tuple[Part[Any], ...]:
    at = [term.linear(field, state, anchor) for term, anchor in zip(terms, anchors, strict=True)]
    return tuple(part_of(term, in_all_columns(term, state, x), fisher) for term, x in zip(terms, at, strict=True))


def weighted_products(
    J: Tensor,  # (M, R, D)
    gradient_weight: Tensor,  # (M, R)
    hessian_weight: Tensor,  # (M, R)
) -> Tensor:  # (M, D + 1, D)
    """Return `sum w_H J^T J` of each block and, as the last row, `sum w_g J`; float64.

    The rows of a block are summed in their own precision; the blocks of a car are summed in float64.
    """
    weighted = torch.cat([J * hessian_weight[..., None], gradient_weight[..., None]], dim=-1)
    return torch.bmm(weighted.mT, J).to(torch.float64)


class Evaluation(NamedTuple):
    """An `Evaluation` is the energy of B cars at one state, float64, with the anchors for the next one."""

    cost: Tensor  # (B,)
    gradient: Tensor  # (B, D)
    hessian: Tensor  # (B, D, D) Gauss-Newton matrix
    anchors: tuple[object, ...]  # of each term


class Figures(NamedTuple):
    """`Figures` are the energy of B cars at one state, for each of the T columns of its terms, float64."""

    term_costs: Tensor  # (B, T)
    gradient: Tensor  # (B, T, D)
    hessian: Tensor  # (B, T, D, D)
    information: Tensor  # (B, T, D, D) Fisher matrix, up to one calibration factor
    parts: tuple[Part[Any], ...]  # part of each term

    @property
    def cost(self) -> Tensor:
        """Cost (B,) of all terms together."""
        return self.term_costs.sum(dim=1)


def summed(sums: CarSums, weight: Tensor, parts: Sequence[Part[Any]]) -> Evaluation:
    """The evaluation that sums the blocks of all terms, with weights (M,) of these blocks."""
    products = sums.sum(torch.cat([part.products for part in parts]), weight)
    cost = sums.sum(torch.cat([part.cost for part in parts]), weight)
    return Evaluation(cost, products[:, -1], products[:, :-1], tuple(part.anchor for part in parts))


def by_autograd(
    terms: Sequence[AnyTerm], prior: ShapePrior, state: State, anchors: Sequence[object]
) -> list[tuple[Tensor, Tensor]]:
    """Return residuals (M, R, N) of every term and their Jacobian (M, R, N, D) by forward-mode differentiation.

    Anchors are constants, as in the hand-derived form.
    """

    def residuals(moved: State) -> list[Tensor]:
        field = field_of(prior.bind(moved.code))
        return [term.residual(field, moved, anchor) for term, anchor in zip(terms, anchors, strict=True)]

    return list(zip(*state.unknowns.derivative(residuals, state), strict=True))
