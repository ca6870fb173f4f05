"""This module checks terms of users; its messages name the term, what was expected and what was given."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.gradient_mode import map_tensors
from directshape_torch.numerics.records import declared
from directshape_torch.numerics.tables import Chosen, is_table, of
from directshape_torch.rows import Blocks
from directshape_torch.shape.field import Field, field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, State
from directshape_torch.terms.term import AnchorT, AnyTerm, Linear, Prepared, Term, has_linear, linear_of, part_of

_OWN = ("names", "blocks", "block_weight", "information", "row_weight", "residual", "norm")
_DEFAULTS = ("sees", "is_prior", "column", "begin", "changing_rows", "anchor", "linear")
# Matrices and gradients may differ by this share of their largest entry: by more than rounding, less than 1 cm causes.
_ROUNDING = 1e-4
_BLOCKS = POSE, CODE, OFFSET
_DECLARE = (
    'Annotated[Tensor, Dense("B", 3)] has a row for each car, Dense("M", 3) for each block, Dense(3) is for all cars'
)
_LEAVING = "hand tensors of the cars to PriorTerm(values=...), or keep them in fields that declare their axes"


def check_members(term: AnyTerm) -> None:
    """Raise `InputError` unless a term has all members of `Term`, names for its columns and known blocks."""
    missing = [name for name in (*_OWN, *_DEFAULTS) if not _has(term, name)]
    if missing:
        raise InputError(f"extra term {type(term).__name__}", "the members of `Term`", f"none called {missing[0]}")
    names = term.names
    if not (isinstance(names, tuple) and names and all(isinstance(name, str) for name in names)):
        raise InputError(f"extra term {type(term).__name__}: names", "a tuple of at least one str", repr(names))
    sees = term.sees
    if sees != tuple(block for block in _BLOCKS if block in sees):
        cure = f"a tuple of some of {', '.join(map(repr, _BLOCKS))}, in this order"
        raise InputError(f"extra term {names[0]!r}: sees", "names of blocks of unknowns", repr(sees), cure)


@torch.no_grad()
def check_term(
    term: AnyTerm, prior: ShapePrior, stage: StageConfig, prepared: Prepared, taken: Collection[str]
) -> None:
    """Raise `InputError` unless all values of a term at a state have the types and shapes that `Term` requires.

    The term is also evaluated after some cars have left: the values of the remaining cars must stay unchanged.

    Args:
        term: term of B cars before any stage, with all members (`check_members`).
        prior: family of shapes.
        stage: first stage.
        prepared: any state of these cars.
        taken: names of other terms.
    """
    names, called = term.names, f"extra term {term.names[0]!r}"
    if len(set(names)) < len(names) or not set(names).isdisjoint(taken):
        raise InputError(f"{called}: names", f"names that no other column has ({', '.join(taken)})", repr(names))
    num_cars = len(prepared.state.code)
    _check_fields(called, term, {"B": num_cars})
    begun = term.begin(stage, prepared)
    _check_rows(f"{called} after begin(...)", begun, num_cars)
    _check_linear(f"{called}: linear(...)", begun, prior, prepared, begun.anchor(prepared))
    changing, anchor, resting = begun.changing_rows(prepared, False)
    _check_rows(f"{called} after changing_rows(...)", changing, num_cars)
    _check_linear(f"{called} after changing_rows(...): linear(...)", changing, prior, prepared, anchor)
    check_shape(
        f"{called}: the cost of changing_rows(...)", resting, (num_cars, len(names)), "one for each car and name"
    )
    before = car_products(changing, prior, prepared.field, prepared.state, anchor)
    # The remaining cars are every other car, the last car, or none; in the first two cases all cars get new numbers.
    for numbers in dict.fromkeys((tuple(range(1, num_cars, 2)), tuple(range(num_cars))[-1:], ())):
        if len(numbers) < num_cars:
            keep = torch.zeros(num_cars, dtype=torch.bool, device=prepared.state.code.device)
            keep[list(numbers)] = True
            left, few = f"{called} after of(cars)", of(prepared.state, Chosen(keep, numbers))
            with named_errors(left, len(numbers)):
                now = _products_of(Chosen(keep, numbers), changing, prior, anchor, few)
            check_same(left, now, before, numbers)


def car_products(term: Term[AnchorT], prior: ShapePrior, field: Field, state: State, anchor: AnchorT) -> Tensor:
    """Sums of a term for its cars (B, D + 1, D): the Gauss-Newton matrix, and the gradient as its last row."""
    products = part_of(term, linear_of(term, prior, field, state, anchor), fisher=False).products
    sums = products.new_zeros(len(state.code), *products.shape[1:])
    return sums.index_add(0, term.blocks.owner, products * term.block_weight[:, None, None])


def check_same(called: str, now: Tensor, before: Tensor, numbers: Sequence[int]) -> None:
    """Raise `InputError` unless the sums `now` of the cars `numbers` equal their rows of `before` (B, D + 1, D)."""
    if not numbers:
        return
    expected = before[list(numbers)]
    limit = _ROUNDING * float(before.nan_to_num(posinf=0.0, neginf=0.0).abs().max())
    same = torch.isclose(now, expected, rtol=0.0, atol=limit, equal_nan=True).all(dim=(1, 2))
    if not same.all():
        car = numbers[int((~same).nonzero()[0, 0])]
        raise InputError(called, "the rows that each car had before", f"others of car {car}", _LEAVING)


def _products_of(cars: Chosen, term: Term[AnchorT], prior: ShapePrior, anchor: AnchorT, few: State) -> Tensor:
    """The sums of some cars, computed as in an iteration after the other cars have left."""
    blocks = term.blocks.kept(cars)
    anchor = map_tensors(lambda x: x.index_select(-2, blocks), anchor)
    return car_products(term.of(cars), prior, field_of(prior.bind(few.code)), few, anchor)


@contextmanager
def named_errors(called: str, num_cars: int, cure: str = _LEAVING) -> Iterator[None]:
    """Name the term in errors of a user's code, which arise where tensors do not fit the number of cars."""
    try:
        yield
    except InputError:
        raise
    except (RuntimeError, IndexError, TypeError, ValueError) as error:
        raise InputError(called, f"values for {num_cars} cars", f"{type(error).__name__}: {error}", cure) from error


def _has(term: AnyTerm, name: str) -> bool:
    """Whether a term has a member that is more than an empty member inherited from `Term`."""
    # `hasattr` would evaluate properties, and rows may be known only after a stage has begun.
    is_inherited = name in _OWN and inspect.getattr_static(term, name, None) is vars(Term)[name]
    return name in dir(term) and not is_inherited


def _check_fields(called: str, table: object, sizes: Mapping[int | str, int]) -> None:
    """Check that all tensors of a table have the axes that its fields declare, by which cars that leave take theirs."""
    specs = declared(table)
    names = specs.keys() | getattr(table, "__dict__", {}).keys()
    parts = dict(enumerate(table)) if type(table) is tuple else {name: getattr(table, name) for name in sorted(names)}
    for name, part in parts.items():
        spec = specs.get(str(name))
        if is_table(part) and spec is None:
            blocks = getattr(part, "blocks", None)
            _check_fields(called, part, {**sizes, "M": len(blocks.owner)} if isinstance(blocks, Blocks) else sizes)
        elif isinstance(part, Tensor) and spec is None:
            raise InputError(f"{called}: {name}", "a declaration of its axes", "none", _DECLARE)
        elif isinstance(part, Tensor) and spec is not None:
            check_shape(f"{called}: {name}", part, [sizes.get(size, size) for size in spec.shape], "as declared")


def _check_rows(called: str, term: AnyTerm, num_cars: int) -> None:
    """Check that the blocks belong to cars of this batch, and that each block and row has one weight."""
    blocks = term.blocks
    if not isinstance(blocks, Blocks):
        raise InputError(f"{called}: blocks", "a Blocks", type(blocks).__name__)
    _check_numbers(f"{called}: blocks.owner", blocks.owner, num_cars, "cars")
    counts = torch.bincount(blocks.owner, minlength=num_cars).tolist()
    if list(blocks.counts) != counts:
        raise InputError(f"{called}: blocks.counts", f"the blocks of each car, {counts}", f"{list(blocks.counts)}")
    num_blocks = len(blocks.owner)
    _check_fields(called, term, {"B": num_cars, "M": num_blocks})
    _check_numbers(f"{called}: column", term.column, len(term.names), "names")
    check_shape(f"{called}: column", term.column, (num_blocks,), "one for each block")
    for name, weight in (("block_weight", term.block_weight), ("information", term.information)):
        check_shape(f"{called}: {name}", weight, (num_blocks,), "one for each block")
        if weight.dtype != torch.float64:
            raise InputError(f"{called}: {name}", "float64, for sums", str(weight.dtype), "convert it with .double()")
    of_rows = num_blocks, "R", "N"
    check_shape(f"{called}: row_weight", term.row_weight, of_rows, "one for each block, row and residual")


def _check_numbers(called: str, numbers: Tensor, count: int, of_what: str) -> None:
    check_shape(called, numbers, ("M",))
    if numbers.dtype != torch.int64:
        raise InputError(called, "int64", str(numbers.dtype), "convert it with .long()")
    if len(numbers) and not (int(numbers.min()) >= 0 and int(numbers.max()) < count):
        got = f"{int(numbers.min())}..{int(numbers.max())}"
        raise InputError(called, f"numbers of the {count} {of_what}", got, "number the cars of this batch from 0")


def _check_linear(called: str, term: Term[AnchorT], prior: ShapePrior, prepared: Prepared, anchor: AnchorT) -> None:
    """Check that the factors of the Jacobian, the residuals and the norms fit the rows."""
    field, state = prepared.field, prepared.state
    with named_errors(called, len(state.code)):
        at = term.linear(field, state, anchor) if has_linear(term) else linear_of(term, prior, field, state, anchor)
    if not isinstance(at, Linear):
        raise InputError(called, "a Linear", type(at).__name__)
    of_rows = tuple(term.row_weight.shape)
    check_shape(f"{called}.residual", at.residual, of_rows, f"one for each block, row and residual; {_LEAVING}")
    check_shape(f"{called}.J_residual_inner", at.J_residual_inner, of_rows, "by the row's inner scalar")
    num_columns, seen = at.J_inner_state.shape[-1:], ", ".join(term.sees)
    size = state.unknowns.size if num_columns == (state.unknowns.size,) else state.unknowns.only(*term.sees).size
    by_seen = (*of_rows[:2], size)
    check_shape(f"{called}.J_inner_state", at.J_inner_state, by_seen, f"by {seen}, without the residual's axis")
    with named_errors(called.replace("linear", "residual"), len(state.code)):
        again = term.residual(field, state, at.anchor)
    check_shape(f"{called.replace('linear', 'residual')}", again, of_rows, "those of linear(...)")
    for name, values in term.norm(at.residual)._asdict().items():
        check_shape(f"{called.replace('linear', 'norm')}.{name}", values, of_rows, "one for each residual")
