"""These tests check columns of blocks, placed Jacobians, steps and their limits, stages and bounds of unknowns."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.derivatives import moved
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.state.cars import CarState
from directshape_torch.state.unknowns import CODE, OFFSET, POSE
from directshape_torch.tracks.state import NEXT_POSE, PATH, TrackState, own_and_shared


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def view() -> TrackState:
    """Two views of three codes, one offset, a path and a next view: 6 + 3 + 1 + 9 + 6 columns."""
    T_obj_cam, T_obj_next = se3.exp(random(2, 6)), se3.exp(random(2, 6, seed=1))
    return TrackState(T_obj_cam, random(2, 3), random(2, 1), random(2, 9), T_obj_next[:, None])


def test_blocks_stand_in_the_order_of_the_state() -> None:
    unknowns = view().unknowns
    assert unknowns.size == 25
    spans = {name: unknowns.span(name) for name in (POSE, CODE, OFFSET, PATH, NEXT_POSE)}
    assert [(s.start, s.stop) for s in spans.values()] == [(0, 6), (6, 9), (9, 10), (10, 19), (19, 25)]
    assert unknowns.span(POSE, CODE) == slice(0, 9)
    own, shared = own_and_shared(view().alone)
    assert (own.tolist(), shared.tolist()) == ([0, 1, 2, 3, 4, 5, 9], [6, 7, 8])
    with pytest.raises(AssertionError, match="beside each other"):
        unknowns.span(POSE, OFFSET)


@pytest.mark.parametrize(
    "sees",
    [(POSE, CODE), (CODE,), (OFFSET,), (POSE, PATH), (POSE, CODE, NEXT_POSE), (POSE, CODE, OFFSET, PATH, NEXT_POSE)],
)
def test_a_jacobian_by_some_blocks_is_put_in_their_columns(sees: tuple[str, ...]) -> None:
    unknowns = view().unknowns
    columns = unknowns.columns(sees, torch.device("cpu"))
    J = random(2, 4, len(columns))
    expected = J.new_zeros(2, 4, 25).index_copy(2, columns, J)
    assert torch.equal(unknowns.placed(J, sees), expected)


def test_blocks_that_a_state_has_not_take_no_columns() -> None:
    alone = CarState.of(se3.exp(random(2, 6)), random(2, 3))
    J = random(2, 4, 9)
    assert alone.unknowns.placed(J, (POSE, CODE, OFFSET)) is J
    assert torch.equal(alone.unknowns.placed(J[..., :0], (OFFSET,)), torch.zeros(2, 4, 9, dtype=torch.float64))
    no_offset = view()._replace(offset_px=random(2, 0)).unknowns
    J = random(2, 4, 12)
    expected = torch.nn.functional.pad(J, (6, 6))
    assert torch.equal(no_offset.placed(J, (CODE, PATH)), expected)
    assert no_offset.span(CODE, PATH) == slice(6, 18)


def test_steps_move_every_block() -> None:
    state, step = view(), 0.3 * random(2, 25, seed=5)
    for found, expected in zip(state.unknowns.retract(state, step), moved(state, step), strict=True):
        torch.testing.assert_close(found, expected)
    bounded = state.unknowns.retract(state, 10 * step, max_code=0.5)
    assert bounded.code.abs().max() == 0.5
    assert bounded.path.abs().max() > 0.5


def test_limits_stages_and_bounds() -> None:
    state = view()._replace(code=torch.tensor([[3.0, 0.0, -3.0], [0.0, 0.0, 0.0]], dtype=torch.float64))
    unknowns, device = state.unknowns, torch.device("cpu")
    assert unknowns.largest_steps(device).tolist() == [0.5] * 3 + [0.15] * 3 + [1.0] * 4 + [math.inf] * 15
    assert unknowns.moving("both", device).all()
    assert (~unknowns.moving("pose", device)).nonzero()[:, 0].tolist() == [6, 7, 8]
    # Offset and path belong to neither and move always; the next view has a pose.
    assert unknowns.moving("shape", device).nonzero()[:, 0].tolist() == list(range(6, 19))
    assert (~unknowns.free(state, 3.0)).nonzero().tolist() == [[0, 6], [0, 8]]
