"""Portions of work: none lost, none larger than need be."""

from __future__ import annotations

from itertools import pairwise

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.numerics.tensors import pixels_at_once, portions


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 12), max_size=20), st.integers(1, 20))
def test_portions_cover_everything_in_order(amounts: list[int], most: int) -> None:
    parts = portions(amounts, most)
    assert [n for part in parts for n in range(len(amounts))[part]] == list(range(len(amounts)))
    for part in parts:
        assert sum(amounts[part]) <= most or part.stop - part.start == 1
    # No two neighbours would have gone into one.
    for a, b in pairwise(parts):
        assert sum(amounts[a]) + amounts[b.start] > most


def test_a_graphics_card_is_given_more_at_once() -> None:
    assert pixels_at_once(torch.device("cuda")) > 16 * pixels_at_once(torch.device("cpu"))
