"""False position on functions of one number, many at a time."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from directshape_torch.terms.depth import Bracket

# Falling from above zero to below it between 0 and 1: straight, curved either way, with a kink beside the root, steep.
FUNCTIONS = {
    "straight": lambda x: 0.3 - x,
    "hollow": lambda x: (1 - x) ** 3 - 0.01,
    "bulging": lambda x: 0.99 - x**3,
    "kink": lambda x: torch.where(x < 0.4, 0.401 - x, 0.001 - 4 * (x - 0.4)),
    "steep": lambda x: 1 - torch.exp(3 * (x - 0.2)),
}
ROOTS = {"straight": 0.3, "hollow": 1 - 0.01 ** (1 / 3), "bulging": 0.99 ** (1 / 3), "kink": 0.40025, "steep": 0.2}


def _begun(values: Tensor, ends: Tensor) -> Bracket:
    before = torch.zeros_like(values)
    return Bracket.between(before, values, before + 1, ends)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_superlinear(name: str) -> None:
    function = FUNCTIONS[name]
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    bracket = _begun(function(zero), function(one))
    errors = []
    for _ in range(12):
        bracket = bracket.probed(function(bracket.depth))
        assert 0 <= float(bracket.depth) <= 1
        # The root stays between the ends.
        ends = sorted((float(bracket.latest), float(bracket.other)))
        assert ends[0] - 1e-15 <= ROOTS[name] <= ends[1] + 1e-15
        errors.append(abs(float(bracket.best) - ROOTS[name]))
    assert errors[7] < 1e-3
    assert errors[11] < 1e-9


def test_the_best_depth_is_the_one_of_least_distance() -> None:
    """Not the last one: what is probed may be worse than what was known."""
    bracket = _begun(torch.tensor([0.5]), torch.tensor([-0.1]))
    assert bracket.best.tolist() == [1.0]
    bracket = bracket.probed(torch.tensor([0.4]))
    assert bracket.best.tolist() == [1.0]
    near = bracket.depth
    bracket = bracket.probed(torch.tensor([-0.01])).probed(torch.tensor([0.3]))
    assert torch.equal(bracket.best, near)
