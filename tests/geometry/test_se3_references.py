"""Against torch's matrix exponential and kornia's Lie groups, and kornia's `Se3` from and to matrices."""

from __future__ import annotations

import pytest
import torch
from helpers.twists import REGIMES, twists
from kornia.geometry.liegroup import Se3

from directshape_torch.errors import InputError
from directshape_torch.geometry import se3


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_is_the_matrix_exponential(regime: str) -> None:
    twist = twists(regime)
    matrices = (twist[:, :, None, None] * se3.generators()).sum(1)
    torch.testing.assert_close(se3.exp(twist), torch.linalg.matrix_exp(matrices), atol=1e-13, rtol=0)


@pytest.mark.parametrize("regime", REGIMES)
def test_kornia_agrees(regime: str) -> None:
    twist = twists(regime)
    theirs = Se3.exp(twist)
    T = se3.exp(twist)
    torch.testing.assert_close(T, theirs.matrix(), atol=1e-13, rtol=0)
    torch.testing.assert_close(se3.inverse(T), theirs.inverse().matrix(), atol=1e-13, rtol=0)
    points = twist[:, [4, 0, 5]]
    torch.testing.assert_close(se3.transform(T, points), theirs * points, atol=1e-13, rtol=0)


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-14), (torch.float32, 2e-6)])
def test_there_and_back(regime: str, dtype: torch.dtype, atol: float) -> None:
    T = se3.exp(twists(regime, dtype=dtype))
    pose = se3.to_kornia(T)
    torch.testing.assert_close(se3.from_kornia(pose), T, atol=atol, rtol=0)
    # The quaternion has its real part first, and the tangent its translation.
    assert pose.quaternion.data.shape == (len(T), 4)
    half_angle = twists(regime, dtype=dtype)[:, 3:].norm(dim=1) / 2
    torch.testing.assert_close(pose.quaternion.data[:, 0].abs(), half_angle.cos(), atol=atol, rtol=0)
    torch.testing.assert_close(Se3.exp(twists(regime, dtype=dtype)).matrix(), T, atol=atol, rtol=0)


def test_motions_compose_alike() -> None:
    A, B = se3.exp(twists("uniform")), se3.exp(twists("normal"))
    torch.testing.assert_close(se3.from_kornia(se3.to_kornia(A) * se3.to_kornia(B)), A @ B, atol=1e-13, rtol=0)
    law = se3.to_kornia(A).adjoint() @ twists("normal")[..., None]
    torch.testing.assert_close(A @ B @ se3.inverse(A), se3.exp(law[..., 0]), atol=1e-13, rtol=0)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (2, 3)])
def test_leading_shapes_are_those_of_kornia(shape: tuple[int, ...]) -> None:
    pose = se3.to_kornia(torch.eye(4).repeat(*shape, 1, 1))
    assert pose.log().shape == (*shape, 6)
    assert se3.from_kornia(pose).shape == (*shape, 4, 4)


def test_gradients_flow_where_they_are_asked_for() -> None:
    T = se3.exp(twists("normal", 3))
    pose = se3.to_kornia(T)
    assert not se3.from_kornia(pose).requires_grad
    pose.translation.add_(1)
    torch.testing.assert_close(T, se3.exp(twists("normal", 3)), atol=0, rtol=0)

    twist = twists("normal", 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: se3.to_kornia(se3.exp(d)).log(), twist)
    assert torch.autograd.gradcheck(lambda d: se3.from_kornia(Se3.exp(d)), twist)


def test_a_car_without_a_pose_stays_without_one() -> None:
    T = torch.eye(4).repeat(2, 1, 1)
    T[0, :3] = torch.nan
    back = se3.from_kornia(se3.to_kornia(T))
    assert back[0, :3].isnan().all()
    assert torch.equal(back[1], T[1])


def test_wrong_input_is_named() -> None:
    with pytest.raises(InputError, match=r"motion: expected kornia's Se3, got Tensor"):
        se3.from_kornia(torch.eye(4))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"T: expected shape \(\*, 4, 4\), got \(3, 4\)"):
        se3.to_kornia(torch.zeros(3, 4))
