"""Mistakes in a term of a user are named when the problem is made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers.own_terms import lower_by, made, refine
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rows import Blocks
from directshape_torch.terms.priors import PriorTerm
from directshape_torch.terms.term import Term


def _with(**members: Any) -> type[PriorTerm]:
    return type("Broken", (PriorTerm,), members)


def _own(name: str) -> Callable[[PriorTerm], Any]:
    """A property of the intact term."""
    return getattr(PriorTerm, name).fget  # type: ignore[no-any-return]


def _linear(**changes: Callable[[Tensor], Tensor]) -> Callable[..., Any]:
    def linear(self: PriorTerm, *arguments: Any) -> Any:
        at = PriorTerm.linear(self, *arguments)
        return at._replace(**{name: change(getattr(at, name)) for name, change in changes.items()})

    return linear


def _one_cost_for_all(self: PriorTerm, *arguments: Any) -> Any:
    term, anchor, cost = PriorTerm.changing_rows(self, *arguments)
    return term, anchor, cost[:, 0]


def _blocks(change: Callable[[Blocks], Blocks]) -> property:
    return property(lambda term: change(_own("blocks")(term)))


BROKEN: dict[str, tuple[dict[str, Any], str]] = {
    "one name": ({"names": "user"}, r"Broken: names: expected a tuple of at least one str, got 'user'"),
    "a name that is ours": ({"names": ("tilt",)}, r"'tilt': names: expected names that no other column has .*height"),
    "cars beyond the batch": (
        {"blocks": _blocks(lambda blocks: blocks._replace(owner=blocks.owner + 1))},
        r"'user' after begin\(...\): blocks.owner: expected numbers of the 2 cars, got 1..2; number the cars",
    ),
    "short numbers": (
        {"blocks": _blocks(lambda blocks: blocks._replace(owner=blocks.owner.int()))},
        r"blocks.owner: expected int64, got torch.int32; convert it with .long\(\)",
    ),
    "counts of others": (
        {"blocks": _blocks(lambda blocks: blocks._replace(counts=(2, 0)))},
        r"blocks.counts: expected the blocks of each car, \[1, 1\], got \[2, 0\]",
    ),
    "no Blocks": ({"blocks": property(lambda _: torch.arange(2))}, r"blocks: expected a Blocks, got Tensor"),
    "a column that is not there": (
        {"column": property(lambda term: _own("column")(term) + 1)},
        r"column: expected numbers of the 1 names, got 1..1",
    ),
    "one weight for all": (
        {"block_weight": property(lambda _: torch.tensor(2.0))},
        r"block_weight: expected shape \(2,\), got \(\); one for each block",
    ),
    "information for each row": (
        {"information": property(lambda _: torch.ones(2, 1))},
        r"information: expected shape \(2,\), got \(2, 1\)",
    ),
    "weights in single precision": (
        {"block_weight": property(lambda term: _own("block_weight")(term).float())},
        r"block_weight: expected float64, for sums, got torch.float32; convert it with .double\(\)",
    ),
    "row weights without an axis": (
        {"row_weight": property(lambda _: torch.ones(2, 1))},
        r"row_weight: expected shape \(2, R, N\), got \(2, 1\)",
    ),
    "residuals without an axis": (
        {"linear": _linear(residual=lambda x: x[..., 0])},
        r"'user': linear\(...\).residual: expected shape \(2, 1, 1\), got \(2, 1\)",
    ),
    "a Jacobian of the wrong rows": (
        {"linear": _linear(J_residual_inner=lambda x: x[:1])},
        r"linear\(...\).J_residual_inner: expected shape \(2, 1, 1\), got \(1, 1, 1\)",
    ),
    "a Jacobian without the rotation": (
        {"linear": _linear(J_inner_state=lambda x: x[..., :3])},
        r"linear\(...\).J_inner_state: expected shape \(2, 1, 6\), got \(2, 1, 3\); by pose",
    ),
    "no Linear": ({"linear": lambda *_: torch.zeros(2)}, r"linear\(...\): expected a Linear, got Tensor"),
    "another residual": (
        {"residual": lambda *_: torch.zeros(2, 3, 1)},
        r"'user': residual\(...\): expected shape \(2, 1, 1\), got \(2, 3, 1\); those of linear",
    ),
    "a norm of everything": (
        {"norm": lambda self, residual: PriorTerm.norm(self, residual.sum())},
        r"'user': norm\(...\).rho: expected shape \(2, 1, 1\), got \(\)",
    ),
    "a norm without weights": (
        {"norm": lambda self, residual: PriorTerm.norm(self, residual)._replace(hessian_weight=torch.ones(2))},
        r"'user': norm\(...\).hessian_weight: expected shape \(2, 1, 1\), got \(2,\)",
    ),
    "one cost for all names": (
        {"changing_rows": _one_cost_for_all},
        r"the cost of changing_rows\(...\): expected shape \(2, 1\)",
    ),
    "cars that do not leave": (
        {"of": lambda self, _: self},
        r"'user' after of\(cars\): expected values for 1 cars, got .*; hand tensors",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_mistake_in_a_term_is_named_when_the_problem_is_made(case: str) -> None:
    members, message = BROKEN[case]
    prior, scene = cached_street()
    refiner = DirectShapeRefiner(prior, DEFAULT, [made(_with(**members))])
    with pytest.raises(InputError, match=r"^extra term .*" + message):
        refiner.problem(scene.frames, scene.detections)


REQUIRED = ("names", "blocks", "block_weight", "information", "row_weight", "residual", "norm")


@pytest.mark.parametrize("name", REQUIRED)
def test_what_a_subclass_leaves_out_is_named_unless_it_has_a_default(name: str) -> None:
    members = {member: getattr(PriorTerm, member) for member in REQUIRED if member != name}
    kind = type("Short", (Term,), members)
    with pytest.raises(InputError, match=f"extra term Short: expected the members of `Term`, got none called {name}"):
        refine(lambda *_: kind())


@pytest.mark.parametrize("sees", [("poses",), "pose", ("pose", "pose"), ("path",), ("code", "pose")])
def test_blocks_that_no_car_has_or_in_another_order_are_named(sees: Any) -> None:
    with pytest.raises(InputError, match=r"'user': sees: expected names of blocks of unknowns.*'offset'"):
        refine(lambda *scene: PriorTerm("user", 1.0, scene[2], lower_by(0.1), 1, sees))


def test_a_residual_that_is_none_is_named() -> None:
    with pytest.raises(InputError, match=r"'user': its residual: expected a Tensor or a PriorResidual, got None"):
        refine(made(residual_of=lambda *_: None))


def test_two_terms_of_one_name_are_named() -> None:
    with pytest.raises(InputError, match=r"extra term 'user': names: expected names that no other column has"):
        refine(made(), made())
