"""Rigid motions agree with the matrix exponential, kornia's Lie groups and their laws, in every regime."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import pytest
import torch
from kornia.geometry.liegroup import Se3, So3
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from directshape_torch.errors import InputError
from directshape_torch.geometry import se3

AXIS = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
REGIMES = ("uniform", "normal", "near_identity", "near_pi", "zero")


def twists(regime: str, count: int = 40, dtype: torch.dtype = torch.float64) -> Tensor:
    """Twists (count, 6) with rotation angles below pi."""
    generator = torch.Generator().manual_seed(REGIMES.index(regime))
    v = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    uniform = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    if regime == "uniform":
        omega = axis * uniform * (math.pi - 0.05)
    elif regime == "normal":
        omega = 0.3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    elif regime == "near_identity":
        v, omega = 1e-7 * v, axis * 1e-7
    elif regime == "near_pi":
        omega = axis * (math.pi - 10 ** (-6 * uniform - 1))
    else:
        v, omega = 0 * v, 0 * axis
    return torch.cat([v, omega], dim=-1).to(dtype)


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_is_the_matrix_exponential(regime: str) -> None:
    twist = twists(regime)
    matrices = (twist[:, :, None, None] * se3.generators()).sum(1)
    torch.testing.assert_close(se3.exp(twist), torch.linalg.matrix_exp(matrices), atol=1e-13, rtol=0)
    single = twists(regime, dtype=torch.float32)
    torch.testing.assert_close(se3.exp(single).double(), se3.exp(single.double()), atol=2e-6, rtol=0)


def test_translations_come_first() -> None:
    G = se3.generators(torch.float32)
    assert G.dtype == torch.float32
    point = torch.tensor([1.0, 2.0, 3.0, 1.0])
    # v, then omega x (1, 2, 3) for the three axes, by hand.
    expected = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -3, 2], [3, 0, -1], [-2, 1, 0]], dtype=torch.float32)
    torch.testing.assert_close((G @ point)[:, :3], expected)


@pytest.mark.parametrize("regime", REGIMES)
def test_inverse_is_two_sided(regime: str) -> None:
    T = se3.exp(twists(regime))
    identity = torch.eye(4, dtype=T.dtype).expand_as(T)
    torch.testing.assert_close(se3.inverse(T) @ T, identity, atol=1e-14, rtol=0)
    torch.testing.assert_close(T @ se3.inverse(T), identity, atol=1e-14, rtol=0)


def test_transform_broadcasts_one_transform_over_points() -> None:
    T = se3.exp(twists("uniform", 1))[0]
    points = torch.randn(7, 3, dtype=T.dtype)
    expected = torch.stack([T[:3, :3] @ p + T[:3, 3] for p in points])
    torch.testing.assert_close(se3.transform(T, points), expected)


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_gradcheck(regime: str) -> None:
    assert gradcheck(se3.exp, twists(regime, 3).requires_grad_())
    if regime in ("uniform", "zero", "near_identity"):
        assert gradgradcheck(se3.exp, twists(regime, 2).requires_grad_())


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.7, 3.1415926])
def test_left_jacobian_of_the_exponential(angle: float) -> None:
    """`exp(xi + d) = exp(J_l d) exp(xi)` to first order; J_l = sum ad^n / (n + 1)! is a block of an exponential."""
    twist = torch.cat([torch.tensor([3.0, -1.0, 20.0], dtype=torch.float64), angle * AXIS])
    v, omega = So3.hat(twist.view(2, 3))
    ad = torch.block_diag(omega, omega)
    ad[:3, 3:] = v
    J = torch.linalg.matrix_exp(torch.cat([torch.cat([ad, torch.eye(6)], 1), torch.zeros(6, 12)]).double())[:6, 6:]
    expected = torch.einsum("gij,gk->ijk", se3.generators() @ se3.exp(twist), J)
    torch.testing.assert_close(torch.func.jacfwd(se3.exp)(twist), expected, rtol=1e-10, atol=1e-10)


def test_the_series_is_exact_where_it_is_used() -> None:
    """Against the closed forms, with more digits than float64 has."""
    t = se3._SERIES_ANGLE_SQUARED
    with localcontext(prec=60):
        terms = [Decimal(-t) ** n / math.factorial(2 * n + 2) for n in range(30)]
        b, c = sum(terms), sum(term / (2 * n + 3) for n, term in enumerate(terms))
    found = se3._higher_exp_coefficients(torch.tensor([t * (1 - 1e-16)], dtype=torch.float64), math.inf)
    torch.testing.assert_close(found, torch.tensor([b, c], dtype=torch.float64), atol=0, rtol=3e-16)


@pytest.mark.parametrize("angle", [0.0, 0.59, 0.6, 3.0])
def test_a_known_largest_angle_changes_no_result(angle: float) -> None:
    """Below the threshold of the series, and above it, where series would be wrong: as much as they leave out."""
    twist = torch.cat([torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), angle * AXIS])
    torch.testing.assert_close(se3.exp(twist, angle + 1e-3), se3.exp(twist), atol=0, rtol=0)
    turn = torch.cat([torch.zeros(3, dtype=torch.float64), angle * AXIS])
    error = float(torch.linalg.matrix_norm(se3.exp(turn, 0.59) - se3.exp(turn), ord=2))
    assert error == pytest.approx(angle**16 / math.factorial(16), rel=0.03, abs=1e-15)


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-14), (torch.float32, 2e-6)])
def test_there_and_back_by_kornia(regime: str, dtype: torch.dtype, atol: float) -> None:
    twist = twists(regime, dtype=dtype)
    T = se3.exp(twist)
    theirs = se3.to_kornia(T)
    torch.testing.assert_close(se3.from_kornia(theirs), T, atol=atol, rtol=0)
    torch.testing.assert_close(Se3.exp(twist).matrix(), T, atol=10 * atol, rtol=0)
    torch.testing.assert_close(se3.exp(theirs.log()), T, atol=10 * atol, rtol=0)
    # The quaternion has its real part first, and the tangent its translation.
    assert theirs.quaternion.data.shape == (len(T), 4)
    half_angle = twist[:, 3:].norm(dim=1) / 2
    torch.testing.assert_close(theirs.quaternion.data[:, 0].abs(), half_angle.cos(), atol=atol, rtol=0)
    if dtype == torch.float64:
        torch.testing.assert_close(theirs.log(), twist, atol=1e-12, rtol=1e-12)


def test_gradients_flow_where_they_are_asked_for() -> None:
    T = se3.exp(twists("normal", 3))
    theirs = se3.to_kornia(T)
    assert not se3.from_kornia(theirs).requires_grad
    theirs.translation.add_(1)
    torch.testing.assert_close(T, se3.exp(twists("normal", 3)), atol=0, rtol=0)

    twist = twists("normal", 3).requires_grad_()
    assert gradcheck(lambda d: se3.to_kornia(se3.exp(d)).log(), twist)
    assert gradcheck(lambda d: se3.from_kornia(Se3.exp(d)), twist)


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
