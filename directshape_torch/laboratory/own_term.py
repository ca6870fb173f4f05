"""A term of one's own: found by name, and the shapes of what it gives held against the protocol `Term`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.table_lookup import occurrences
from directshape_torch.problem import TermFactory
from directshape_torch.terms.term import Sight, Term, linear_of


def load_factory(name: str) -> TermFactory:
    """The factory `(frames, detections, cars, prior) -> Term` that "module:factory" names.

    Raises:
        InputError: there is no such module or factory.
    """
    module, _, attribute = name.partition(":")
    try:
        factory: TermFactory = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        cure = "give the name of a module that can be imported and of a function in it, as in my_terms:upright"
        raise InputError("term", "module:factory", f"{name!r}: {error}", cure) from error
    return factory


@torch.no_grad()
def checked_term(term: Term, sight: Sight) -> Term:
    """A term, whose stage has begun, that keeps to the shapes of the protocol.

    Raises:
        InputError: it does not; names what is wrong.
    """
    name, num_cars = term.names[0], len(sight.state.code)
    blocks, owner = term.blocks, term.blocks.owner
    num_blocks, num_columns = len(owner), len(term.names)
    _check(name, "blocks.counts", blocks.counts, tuple(occurrences(owner, num_cars).tolist()), "blocks of each car")
    _check_shape(name, "column", term.column, (num_blocks,))
    if not bool(((term.column >= 0) & (term.column < num_columns)).all()):
        _check(name, "column", sorted(set(term.column.tolist())), list(range(num_columns)), "numbers of its names")
    for attribute, weight in (("block_weight", term.block_weight), ("information", term.information)):
        _check_shape(name, attribute, weight, (num_blocks,))
        _check(name, f"{attribute}.dtype", weight.dtype, torch.float64, "for sums")
    at = linear_of(term, sight.field, sight.state, term.where(sight))
    if at.residual.ndim != 3 or len(at.residual) != num_blocks:
        _check(
            name, "linear(...).residual", tuple(at.residual.shape), (num_blocks, "R", "N"), "blocks, rows, residuals"
        )
    shape = tuple(at.residual.shape)
    _check_shape(name, "linear(...).J_residual_inner", at.J_residual_inner, shape)
    _check_shape(name, "linear(...).J_inner_state", at.J_inner_state, (*shape[:2], sight.state.num_unknowns))
    _check_shape(name, "residual(...)", term.residual(sight.field, sight.state, at.where), shape)
    _check_shape(name, "row_weight", term.row_weight, shape)
    for part, values in term.norm(at.residual)._asdict().items():
        _check_shape(name, f"norm(...).{part}", values, shape)
    _check_shape(name, "moving(...)[2]", term.moving(sight, False)[2], (num_cars, num_columns))
    return term


def _check_shape(name: str, what: str, values: Tensor, shape: Sequence[int]) -> None:
    _check(name, what, tuple(values.shape), tuple(shape), "shape")


def _check(name: str, what: str, got: object, expected: object, meaning: str) -> None:
    if got != expected:
        raise InputError(f"term {name!r}", f"{what} of {expected} ({meaning})", f"{got}", "see terms/term.py, `Term`")
