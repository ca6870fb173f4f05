"""Photometric residual: exact depth derivative, derivative by the depth, grazing rays, borders, the rig's bias."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import (
    central_differences,
    differences_by_state,
    jacobian_by_state,
    of_own_object,
    relative_error,
)
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor

from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.pinhole import rays_from_pixels
from directshape_torch.residuals.photometric import (
    DSO_PATTERN,
    depth_state_jacobian,
    photometric_residual,
    surface_slope,
)
from directshape_torch.shape.raycast import ObjectRays, attached_depth, closest_approach_depth, first_crossing, march
from directshape_torch.shape.shape_prior import SdfDerivatives

K = torch.tensor([[720.0, 0.0, 600.0], [0.0, 720.0, 170.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
MIN_COSINE = 0.1


def object_rays(state: CarState, ray_cam: Tensor) -> ObjectRays:
    T = state.T_obj_cam[0]
    return ObjectRays(T[:3, 3].expand_as(ray_cam), ray_cam @ T[:3, :3].T, torch.zeros(len(ray_cam), dtype=torch.long))


def root_of(state: CarState, ray_cam: Tensor, iterations: int = 40) -> tuple[ObjectRays, Tensor, Tensor]:
    prior = ellipsoid_prior()
    rays, shape = object_rays(state, ray_cam), prior.bind(state.code)
    marched = march(shape, rays, prior.bounds_obj, 48)
    root = first_crossing(shape, rays, marched, closest_approach_depth(marched), iterations)
    return rays, root.depth, root.found


def rays_over(depth_m: float, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(9)
    spread = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 2 - 1
    centre = 720 * torch.tensor([1.0, 0.85], dtype=torch.float64) / depth_m + K[:2, 2]
    return rays_from_pixels(centre + spread * 720 * torch.tensor([1.9, 0.7]) / depth_m, K)


@pytest.mark.parametrize("sigma", [0.0, 3.0])
@pytest.mark.parametrize("depth_m", [5.0, 15.0, 80.0])
def test_depth_jacobian_three_ways(depth_m: float, sigma: float) -> None:
    """Against the derivative of the root itself: found anew at each displaced state, and by autograd."""
    prior = ellipsoid_prior()
    T_cam_obj = pose_from_kitti(torch.tensor([1.0, 1.6, depth_m]).double(), torch.tensor(0.5).double())
    code = torch.tensor([[sigma, -sigma / 3, sigma / 2]], dtype=torch.float64)
    state = CarState(se3.inverse(T_cam_obj)[None], code)
    ray_cam = rays_over(depth_m, 80)
    rays, root, found = root_of(state, ray_cam)
    at = prior.bind(code).value_and_derivatives(rays.at(root), rays.object_index)
    surface = depth_state_jacobian(rays.at(root), at, rays.direction_obj, MIN_COSINE)
    clear = surface_slope(at.gradient, rays.direction_obj, 0.25)[1].logical_not()
    # Rays whose root lies within a hair of a cell's face have two derivatives, left and right.
    position = ((rays.at(root) - prior.origin) / prior.spacing_m).remainder(1.0)
    usable = found & clear & ((position > 1e-3) & (position < 1 - 1e-3)).all(1)
    assert usable.sum() > 25

    def by_newton(moved: CarState) -> Tensor:
        return attached_depth(prior.bind(moved.code), object_rays(moved, ray_cam), root, found & ~surface.grazing)

    index = rays.object_index
    analytic = surface.J_depth_state[usable]
    by_autograd = of_own_object(jacobian_by_state(by_newton, state), index)[usable]
    numeric = of_own_object(differences_by_state(lambda s: root_of(s, ray_cam)[1], state, 1e-6), index)[usable]
    assert relative_error(analytic, by_autograd) < 1e-9
    assert relative_error(analytic, numeric) < 1e-5


def test_depth_derivative_is_not_one_over_cosine() -> None:
    """A gradient of length 0.8 and a ray that is not of unit length: -1 / (grad . ray), by hand."""
    gradient = torch.tensor([[0.0, -0.48, -0.64]], dtype=torch.float64)
    direction = torch.tensor([[0.5, 0.0, 1.0]], dtype=torch.float64)
    at = SdfDerivatives(torch.zeros(1).double(), gradient, torch.tensor([[0.2]], dtype=torch.float64))
    point = torch.tensor([[1.0, -1.0, 0.5]], dtype=torch.float64)
    surface = depth_state_jacobian(point, at, direction, MIN_COSINE)
    # -1 / -0.64 = 1.5625; X x grad = (-1*-0.64 - 0.5*-0.48, 0.5*0 - 1*-0.64, 1*-0.48 - 0) = (0.88, 0.64, -0.48).
    expected = 1.5625 * torch.tensor([[0.0, -0.48, -0.64, 0.88, 0.64, -0.48, 0.2]], dtype=torch.float64)
    torch.testing.assert_close(surface.J_depth_state, expected)


def test_grazing_rays_have_no_derivative() -> None:
    # |grad . ray| / (|grad| |ray|) is 0.099 and 0.101.
    gradient = torch.tensor([[0.5, 0.0, 0.0]], dtype=torch.float64).repeat(2, 1)
    cosine = torch.tensor([0.099, 0.101], dtype=torch.float64)
    direction = 3 * torch.stack([cosine, 0 * cosine, (1 - cosine**2).sqrt()], dim=1)
    at = SdfDerivatives(torch.zeros(2).double(), gradient, torch.zeros(2, 1).double())
    surface = depth_state_jacobian(torch.ones(2, 3).double(), at, direction, 0.1)
    assert surface.grazing.tolist() == [True, False]
    assert (surface.J_depth_state[0] == 0).all()
    assert surface.J_depth_state[1].isfinite().all()
    tangent = depth_state_jacobian(torch.ones(1, 3).double(), SdfDerivatives(*(x[:1] for x in at)),
                                   torch.tensor([[0.0, 0.0, 1.0]]).double(), 0.0)  # fmt: skip
    assert not tangent.J_depth_state.isnan().any()


def test_dso_pattern_has_eight_pixels_and_its_centre() -> None:
    assert len(set(DSO_PATTERN)) == 8
    assert (0, 0) in DSO_PATTERN
    assert all(abs(u) + abs(v) <= 2 for u, v in DSO_PATTERN)


HEIGHT, WIDTH = 60, 90
K_SMALL = torch.tensor([[80.0, 0, 44.0], [0, 80.0, 30.0], [0, 0, 1]], dtype=torch.float64)
T_RIGHT_CAM = se3.exp(torch.tensor([-0.5, -0.003, 0.004, 0.002, -0.004, 0.001], dtype=torch.float64))


def _residual(
    depth: Tensor,
    uv: Tensor,
    image: Tensor,
    scale: float = 1.0,
    bias: Tensor | None = None,
    vertical: Tensor | None = None,
):  # type: ignore[no-untyped-def]
    pattern = torch.tensor(DSO_PATTERN, dtype=torch.float64)
    rays = rays_from_pixels(uv[:, None] + pattern / scale, K_SMALL)
    count = len(uv)
    return photometric_residual(
        image,
        torch.tensor([[image.shape[1], image.shape[2]]]),
        scale,
        torch.zeros(count, dtype=torch.long),
        torch.full((count, 8), 100.0, dtype=torch.float64),
        rays,
        depth,
        K_SMALL.expand(count, 3, 3),
        T_RIGHT_CAM.expand(count, 4, 4),
        bias,
        vertical,
        DSO_PATTERN.index((0, 0)),
    )


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("depth_m", [3.0, 10.0, 80.0])
def test_derivative_by_the_depth_three_ways(depth_m: float, scale: float) -> None:
    generator = torch.Generator().manual_seed(10)
    image = 255 * torch.rand(1, int(HEIGHT * scale), int(WIDTH * scale), generator=generator, dtype=torch.float64)
    uv = torch.tensor([[40.0, 20.0], [60.0, 31.0], [70.0, 40.0]], dtype=torch.float64)
    depth = depth_m * torch.tensor([1.0, 1.1, 0.93], dtype=torch.float64)
    analytic = _residual(depth, uv, image, scale)
    assert analytic.inside.all()
    row = torch.arange(3)

    def values(d: Tensor) -> Tensor:
        result: Tensor = _residual(d, uv, image, scale).residual
        return result

    by_autograd = torch.autograd.functional.jacobian(values, depth)
    assert isinstance(by_autograd, Tensor)
    torch.testing.assert_close(analytic.J_residual_depth, by_autograd[row, :, row], rtol=1e-10, atol=1e-10)
    numeric = central_differences(values, depth, 1e-7 * depth_m)[row, :, row]
    # A step that crosses into the next pixel sees another slope; none of these does.
    torch.testing.assert_close(analytic.J_residual_depth, numeric, rtol=1e-5, atol=1e-4)


def test_residual_is_right_minus_left() -> None:
    bright_right = torch.full((1, HEIGHT, WIDTH), 130.0, dtype=torch.float64)
    result = _residual(torch.tensor([10.0]).double(), torch.tensor([[50.0, 30.0]]).double(), bright_right)
    torch.testing.assert_close(result.residual, torch.full((1, 8), 30.0, dtype=torch.float64))


def test_residual_on_a_ramp_by_hand() -> None:
    """I_r(u, v) = u on full resolution: residual and derivative are those of the warp itself, at every level."""
    ramp = torch.arange(WIDTH, dtype=torch.float64).expand(1, HEIGHT, WIDTH).contiguous()
    uv, depth = torch.tensor([[50.0, 30.0]]).double(), torch.tensor([8.0]).double()
    fine = _residual(depth, uv, ramp)
    point = se3.transform(T_RIGHT_CAM, depth[:, None] * rays_from_pixels(uv, K_SMALL))
    u_right = 80 * point[0, 0] / point[0, 2] + 44
    centre = DSO_PATTERN.index((0, 0))
    torch.testing.assert_close(fine.residual[0, centre], u_right - 100)
    torch.testing.assert_close(fine.uv_right[0, 0], u_right)
    half = ramp.view(1, HEIGHT // 2, 2, WIDTH // 2, 2).mean((2, 4))
    coarse = _residual(depth, uv, half, 0.5)
    torch.testing.assert_close(coarse.residual[0, centre], fine.residual[0, centre])
    torch.testing.assert_close(coarse.J_residual_depth[0, centre], fine.J_residual_depth[0, centre])


def test_bias_moves_the_lookup_to_the_left() -> None:
    ramp = torch.arange(WIDTH, dtype=torch.float64).expand(1, HEIGHT, WIDTH).contiguous()
    uv, depth = torch.tensor([[50.0, 30.0]]).double(), torch.tensor([8.0]).double()
    biased = _residual(depth, uv, ramp, bias=torch.tensor([0.7]).double())
    torch.testing.assert_close(biased.residual, _residual(depth, uv, ramp).residual - 0.7)
    rows = torch.arange(HEIGHT, dtype=torch.float64)[:, None].expand(1, HEIGHT, WIDTH).contiguous()
    lower = _residual(depth, uv, rows, vertical=torch.tensor([0.4]).double())
    torch.testing.assert_close(lower.residual, _residual(depth, uv, rows).residual + 0.4)


def test_pixels_that_leave_the_right_image_say_so() -> None:
    image = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.float64)
    uv = torch.tensor([[50.0, 30.0], [8.0, 30.0], [50.0, 1.0], [50.0, 58.0]], dtype=torch.float64)
    # At 4 m the disparity is 10 px: pixel 8 lands left of the image; rows 1 and 58 lose a neighbour 2 px away.
    inside = _residual(torch.full((4,), 4.0).double(), uv, image).inside
    assert inside.tolist() == [True, False, False, False]


def test_no_pixels() -> None:
    result = _residual(torch.zeros(0).double(), torch.zeros(0, 2).double(), torch.zeros(1, HEIGHT, WIDTH).double())
    assert result.residual.shape == result.J_residual_depth.shape == (0, 8)
    assert result.inside.shape == (0,)
