"""A check of terms that users bring, with messages that say which term, what was expected and what came."""

from __future__ import annotations

import inspect
from collections.abc import Collection

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.rows import Blocks
from directshape_torch.terms.term import Linear, Sight, Term, Where, linear_of

_OWN = ("names", "blocks", "block_weight", "information", "row_weight", "linear", "residual", "norm", "of_cars")
_DEFAULTS = ("is_prior", "column", "begin", "moving", "where")


@torch.no_grad()
def check_term(term: Term, stage: StageConfig, sight: Sight, taken: Collection[str]) -> None:
    """Raise `InputError` unless all that a term gives at a state has the types and shapes that `Term` says.

    Args:
        term: of B cars, no stage begun.
        stage: the first one.
        sight: what rays see at any state of these cars.
        taken: names of other terms.
    """
    missing = [name for name in (*_OWN, *_DEFAULTS) if not _has(term, name)]
    if missing:
        raise InputError(f"extra term {type(term).__name__}", "the members of `Term`", f"none called {missing[0]}")
    names = term.names
    if not (isinstance(names, tuple) and names and all(isinstance(name, str) for name in names)):
        raise InputError(f"extra term {type(term).__name__}: names", "a tuple of at least one str", repr(names))
    called = f"extra term {names[0]!r}"
    if len(set(names)) < len(names) or not set(names).isdisjoint(taken):
        raise InputError(f"{called}: names", f"names that no other column has ({', '.join(taken)})", repr(names))
    num_cars = len(sight.state.code)
    begun = term.begin(stage, sight)
    _check_rows(f"{called} after begin(...)", begun, num_cars)
    _check_linear(f"{called}: linear(...)", begun, begun.where(sight), sight)
    moving, where, resting = begun.moving(sight, False)
    _check_rows(f"{called} after moving(...)", moving, num_cars)
    _check_linear(f"{called} after moving(...): linear(...)", moving, where, sight)
    check_shape(f"{called}: the cost of moving(...)", resting, (num_cars, len(names)), "one for each car and name")
    if num_cars:
        keep = torch.arange(num_cars, device=sight.state.code.device) > 0
        part = moving.of_cars(keep, range(1, num_cars))
        _check_rows(f"{called} after of_cars(...)", part, num_cars - 1)


def _has(term: Term, name: str) -> bool:
    """Whether it has a member, and not only the empty one that a subclass of `Term` inherits."""
    # Not `hasattr`: rows may be known only when a stage has begun.
    is_inherited = name in _OWN and inspect.getattr_static(term, name, None) is vars(Term)[name]
    return name in dir(term) and not is_inherited


def _check_rows(called: str, term: Term, num_cars: int) -> None:
    """Blocks of the cars in this batch, and one weight for each block and row."""
    blocks = term.blocks
    if not isinstance(blocks, Blocks):
        raise InputError(f"{called}: blocks", "a Blocks", type(blocks).__name__)
    _check_numbers(f"{called}: blocks.owner", blocks.owner, num_cars, "cars")
    counts = torch.bincount(blocks.owner, minlength=num_cars).tolist()
    if list(blocks.counts) != counts:
        raise InputError(f"{called}: blocks.counts", f"the blocks of each car, {counts}", f"{list(blocks.counts)}")
    num_blocks = len(blocks.owner)
    _check_numbers(f"{called}: column", term.column, len(term.names), "names")
    for name, weight in (
        ("column", term.column),
        ("block_weight", term.block_weight),
        ("information", term.information),
    ):
        check_shape(f"{called}: {name}", weight, (num_blocks,), "one for each block")
    for name, weight in (("block_weight", term.block_weight), ("information", term.information)):
        if weight.dtype != torch.float64:
            raise InputError(f"{called}: {name}", "float64, for sums", str(weight.dtype), "convert it with .double()")
    check_shape(
        f"{called}: row_weight", term.row_weight, (num_blocks, "R", "N"), "one for each block, row and residual"
    )


def _check_numbers(called: str, numbers: Tensor, count: int, of_what: str) -> None:
    check_shape(called, numbers, ("M",))
    if numbers.dtype != torch.int64:
        raise InputError(called, "int64", str(numbers.dtype), "convert it with .long()")
    if len(numbers) and not (int(numbers.min()) >= 0 and int(numbers.max()) < count):
        got = f"{int(numbers.min())}..{int(numbers.max())}"
        raise InputError(called, f"numbers of the {count} {of_what}", got, "number the cars of this batch from 0")


def _check_linear(called: str, term: Term, where: Where, sight: Sight) -> None:
    """Factors of the Jacobian that fit the rows, and residuals and norms that fit them."""
    at = term.linear(sight.field, sight.state, where)
    if not isinstance(at, Linear):
        raise InputError(called, "a Linear", type(at).__name__)
    of_rows = tuple(term.row_weight.shape)
    check_shape(f"{called}.residual", at.residual, of_rows, "one for each block, row and residual")
    check_shape(f"{called}.J_residual_inner", at.J_residual_inner, of_rows, "by the row's inner scalar")
    J = linear_of(term, sight.field, sight.state, where).J_inner_state
    by_state = (*of_rows[:2], sight.state.num_unknowns)
    check_shape(f"{called}.J_inner_state", J, by_state, "by (v, omega, dcode), without the residual's axis")
    again = term.residual(sight.field, sight.state, at.where)
    check_shape(f"{called.replace('linear', 'residual')}", again, of_rows, "those of linear(...)")
    for name, values in term.norm(at.residual)._asdict().items():
        check_shape(f"{called.replace('linear', 'norm')}.{name}", values, of_rows, "one for each residual")
