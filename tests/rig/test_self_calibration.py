"""Motion and road recover a field that was put into them, and a road without motion is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField, polynomial_basis
from directshape_torch.geometry.projection import project, rays_from_pixels
from directshape_torch.geometry.se3 import exp
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.geometry.stereo_depth import disparity_of_depth
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.motion import MotionConstraint
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.self_calibration import FieldConstraint, RoadConstraint, SelfCalibration, self_calibrate

SIZE = (1242, 375)
HEIGHT_M = 1.65
TRUE = torch.tensor([-0.4, -0.2, 0.3, -1.0, 0.1, 0.1, 0.3, 0.1, -0.1, -0.3], dtype=torch.float64)


def camera() -> StereoCamera:
    P = torch.tensor([[720.0, 0, 610, 0], [0, 720, 173, 0], [0, 0, 1, 0]], dtype=torch.float64)
    P_right = P.clone()
    P_right[0, 3], P_right[1, 3] = -720 * 0.53, 2.0
    return StereoCamera.from_projections(P[None], P_right[None])


def measured(uv: Tensor, depth: Tensor, generator: torch.Generator, noise_px: float) -> Tensor:
    """Pixels, disparity with the field and noise, and the row shift of the geometry less 0.2 px."""
    rig = camera()
    displacement = disparity_of_depth(uv, depth, rig.K_left[0], rig.K_right[0], rig.T_right_cam[0])
    noise = noise_px * torch.randn(len(uv), generator=generator, dtype=torch.float64)
    disparity = displacement[:, 0] + polynomial_basis(uv, SIZE) @ TRUE + noise
    return torch.cat([uv, disparity[:, None], displacement[:, 1:] - 0.2], dim=1)


def random_pixels(count: int, generator: torch.Generator) -> Tensor:
    return torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor(SIZE)


def motion(
    seed: int,
    way_m: float = 2.0,
    moving_share: float = 0.0,
    noise_px: float = 0.1,
) -> MotionConstraint:
    """Points 5 to 60 m away for a camera that drives ahead and turns a little; some points move by themselves."""
    generator, rig = torch.Generator().manual_seed(seed), camera()
    uv = random_pixels(500, generator)
    depth = 5 + 55 * torch.rand(500, generator=generator, dtype=torch.float64)
    seen = measured(uv, depth, generator, noise_px)
    T_later_cam = exp(torch.tensor([0.02, 0.01, -way_m, 0.002, 0.01 * (seed % 3 - 1), 0.001], dtype=torch.float64))
    own_motion = (torch.rand(len(uv), generator=generator) < moving_share)[:, None] * torch.tensor([0.0, 0.0, 1.5])
    points = depth[:, None] * rays_from_pixels(uv, rig.K_left[0]) + own_motion
    uv_later = project(points @ T_later_cam[:3, :3].T + T_later_cam[:3, 3], rig.K_left[0])
    uv_later = uv_later + noise_px * torch.randn(len(uv), 2, generator=generator, dtype=torch.float64)
    # The rough motion is that of raw disparities: a few per cent too long.
    start = exp(torch.tensor([0.0, 0.0, -0.02 * way_m, 0.001, 0.0, 0.0], dtype=torch.float64)) @ T_later_cam
    return MotionConstraint(Rig.of(rig, SIZE), seen, uv_later, start)


def road(seed: int, noise_px: float = 0.1, pitch: float = 0.0) -> RoadConstraint:
    """A road with a slope of a degree or two, seen from 4 to 30 m."""
    generator, rig = torch.Generator().manual_seed(seed), camera()
    normal = torch.tensor([0.01 * (seed % 3), -1.0, 0.01 * (seed % 2) + pitch], dtype=torch.float64)
    plane = -normal / normal.norm() / HEIGHT_M
    uv = random_pixels(3000, generator)
    depth = 1 / (rays_from_pixels(uv, rig.K_left[0]) @ plane)
    ahead = (depth > 4) & (depth < 30)
    seen = measured(uv[ahead], depth[ahead], generator, noise_px)
    start = plane * torch.tensor([1.0, 1.02, 1.0]) + torch.tensor([0.0, 0.0, 0.004])
    return RoadConstraint(Rig.of(rig, SIZE), seen, start, HEIGHT_M)


def grid() -> Tensor:
    u, v = torch.meshgrid(torch.linspace(40, 1200, 12), torch.linspace(20, 360, 8), indexing="xy")
    return torch.stack([u, v], dim=-1).reshape(-1, 2).double()


def field_of(found: SelfCalibration) -> DisparityField:
    rig = RigEstimate(*Rig.of(camera(), SIZE))
    rig.add_pixels("motion", found.evidence)
    return rig.field


def largest_error(constraints: list[FieldConstraint]) -> float:
    evidence = self_calibrate(constraints, 1).evidence
    found = torch.linalg.solve(evidence.information, evidence.vector)
    return float((polynomial_basis(grid(), SIZE) @ (found - TRUE)).abs().max())


def test_motion_and_road_find_the_field_beside_things_that_move() -> None:
    constraints = [*(motion(k, moving_share=0.2) for k in range(6)), *(road(k) for k in range(4))]
    result = self_calibrate(constraints, 2)
    field = field_of(result)
    error = field.bias(grid()) - polynomial_basis(grid(), SIZE) @ TRUE
    assert float(error.abs().max()) < 0.1
    assert float(error.square().mean().sqrt()) < 0.03
    assert result.converged
    assert result.sigma_px is not None
    assert result.sigma_px < 0.05
    rows = field.offsets(grid())[1]
    torch.testing.assert_close(rows, torch.full_like(rows, 0.2), atol=0.01, rtol=0)


def test_standard_deviation_is_that_of_halves_that_disagree() -> None:
    """The second half's disparities are 0.3 px larger: the halves' mean is off by half of that."""
    first = [motion(k, noise_px=0.02) for k in range(3)]
    second = [shifted(motion(k, noise_px=0.02), 0.3) for k in range(3, 6)]
    steps: list[None] = []
    result = self_calibrate([*first, *second], 1, on_step=lambda: steps.append(None))
    assert result.sigma_px == pytest.approx(0.15, abs=0.03)
    assert len(steps) > 30


def shifted(constraint: MotionConstraint, by_px: float) -> MotionConstraint:
    return replace(constraint, seen=constraint.seen + torch.tensor([0.0, 0.0, by_px, 0.0]))


def test_a_wrong_height_hardly_matters_where_motion_sees_many_depths() -> None:
    """Without noise the field is exact; a road 5 cm lower than it is would be 2 px off at the lower edge by itself."""
    exact: list[FieldConstraint] = [*(motion(k, noise_px=0.0) for k in range(6)), road(0, noise_px=0.0)]
    assert largest_error(exact) < 0.005
    wrong = replace(road(0, noise_px=0.0), height_m=HEIGHT_M + 0.05)
    assert largest_error([*exact[:-1], wrong]) < 0.01


def test_a_road_alone_does_not_determine_a_field() -> None:
    with pytest.raises(InputError, match="no constant, no slope"):
        self_calibrate([road(k) for k in range(10)], 1)


@pytest.mark.parametrize("constraint", [motion(1), road(1, pitch=0.01)], ids=["motion", "road"])
def test_gradient_is_that_of_the_robust_cost(constraint: MotionConstraint | RoadConstraint) -> None:
    """Central differences of Tukey's cost over the coefficients and the constraint's own unknowns."""
    coefficients, scale = 0.9 * TRUE, 3.0
    linear = constraint.linearise(coefficients, scale)
    num_own = len(linear.g) - len(TRUE)
    numeric = torch.zeros_like(linear.g)
    for k in range(len(linear.g)):
        values = []
        for sign in (1.0, -1.0):
            delta = torch.zeros_like(linear.g)
            delta[k] = sign * 1e-5
            moved = constraint.moved(delta[:num_own])
            values.append(cost(distances(moved, coefficients + delta[num_own:]), scale))
        numeric[k] = (values[0] - values[1]) / 2e-5
    weight_sum = float(tukey(distances(constraint, coefficients), scale).sum())
    numeric = numeric * min(1.0, 60 / weight_sum) / scale**2
    if isinstance(constraint, RoadConstraint):
        numeric = numeric + height_gradient(constraint)
    torch.testing.assert_close(linear.g, numeric, rtol=2e-4, atol=2e-4 * float(numeric.abs().max()))


def distances(constraint: FieldConstraint, coefficients: Tensor) -> Tensor:
    return constraint.residuals(coefficients)[0].norm(dim=1)


def tukey(distances: Tensor, scale: float) -> Tensor:
    return (1 - (distances / (4.685 * scale)) ** 2).clamp_min(0) ** 2


def cost(distances: Tensor, scale: float) -> float:
    """Sum of Tukey's rho, whose derivative is r (1 - (r / c)^2)^2."""
    c = 4.685 * scale
    inside = (1 - (distances / c) ** 2).clamp_min(0) ** 3
    return float((c**2 / 6 * (1 - inside)).sum())


def height_gradient(constraint: RoadConstraint) -> Tensor:
    plane = constraint.inverse_plane.clone().requires_grad_(True)
    (0.5 * ((1 / plane.norm() - HEIGHT_M) / 0.02) ** 2).backward()
    assert plane.grad is not None
    return torch.cat([plane.grad, torch.zeros(len(TRUE), dtype=torch.float64)])


def test_standard_deviation_is_not_known_where_half_determines_no_field() -> None:
    result = self_calibrate([*(road(k) for k in range(3)), *(motion(k) for k in range(3))], 1)
    assert result.sigma_px is None
