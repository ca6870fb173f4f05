"""The one place where a state is updated."""

from __future__ import annotations

import torch
from helpers.derivatives import moved
from helpers.twists import twists

from directshape_torch.geometry import se3
from directshape_torch.terms.cars import CarState, retract


def _state() -> CarState:
    return CarState.of(se3.exp(twists("uniform", 3)), torch.tensor([[0.1, -0.2]]).double().repeat(3, 1))


def test_update_is_on_the_left_of_object_from_camera() -> None:
    state, delta = _state(), 0.1 * torch.randn(3, 8, dtype=torch.float64)
    after = retract(state, delta)
    torch.testing.assert_close(after.T_obj_cam, se3.exp(delta[:, :6]) @ state.T_obj_cam)
    torch.testing.assert_close(after.code, state.code + delta[:, 6:])
    for x, y in zip(after, moved(state, delta), strict=True):
        assert (x == y).all()


def test_the_car_turns_about_its_own_origin() -> None:
    turn = torch.tensor([0, 0, 0, 0, 0.3, 0, 0, 0], dtype=torch.float64).expand(3, 8)
    before, after = _state(), retract(_state(), turn)
    origin = [se3.inverse(s.T_obj_cam)[:, :3, 3] for s in (before, after)]
    torch.testing.assert_close(origin[0], origin[1])


def test_translations_are_metres_along_the_cars_axes() -> None:
    forward = torch.tensor([-0.5, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64).expand(3, 8)
    before, after = (se3.inverse(s.T_obj_cam) for s in (_state(), retract(_state(), forward)))
    # The object frame seen from the camera moves by -v: half a metre ahead.
    torch.testing.assert_close(after[:, :3, 3], before[:, :3, 3] + 0.5 * before[:, :3, 0])


def test_the_code_is_bounded_and_keeps_the_dtype_of_the_state() -> None:
    low = CarState.of(torch.eye(4)[None], torch.zeros(1, 2))
    after = retract(low, torch.tensor([[0, 0, 0, 0, 0, 0, 9.0, -9.0]], dtype=torch.float64), max_code=3.0)
    assert after.code.tolist() == [[3.0, -3.0]]
    assert after.code.dtype == after.T_obj_cam.dtype == torch.float32


def test_no_cars() -> None:
    empty = CarState.of(torch.zeros(0, 4, 4), torch.zeros(0, 2))
    assert retract(empty, torch.zeros(0, 8)).T_obj_cam.shape == (0, 4, 4)
