"""Grid lookups of every form agree with a slow loop over corners and autograd, also in blocks and at the zero level."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
import torch.autograd.forward_ad as fwAD
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.shape.field import field_of
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import SdfDerivatives
from directshape_torch.shape.zero_level import zero_level_extents

ORIGIN = torch.tensor([-1.0, -2.0, 0.5], dtype=torch.float64)
SPACING = 0.4
COUNTS = (6, 5, 4)
LAST = ORIGIN + SPACING * (torch.tensor(COUNTS, dtype=torch.float64) - 1)
LookUp = Callable[[GridShape, Tensor, Tensor], SdfDerivatives]


@pytest.fixture(params=["to be differentiated", "constant"])
def look_up(request: pytest.FixtureRequest) -> LookUp:
    """A lookup in each form."""
    constant = request.param == "constant"
    return lambda field, points_obj, owner: field.derivatives(points_obj, owner, constant)


def grids(num_objects: int, num_codes: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    values = torch.randn(num_objects, *COUNTS, generator=generator, dtype=torch.float64)
    return values, torch.randn(*COUNTS, num_codes, generator=generator, dtype=torch.float64)


def random_shape(num_objects: int = 2, num_codes: int = 3, dtype: torch.dtype = torch.float64) -> GridShape:
    values, basis = grids(num_objects, num_codes)
    return GridShape.of(values.to(dtype), basis.to(dtype), ORIGIN.to(dtype), SPACING)


def points(count: int = 75, stretch: float = 1.6) -> Tensor:
    """Points (P, 3), by default two thirds of them outside the grid."""
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    return 0.5 * (ORIGIN + LAST) + stretch * (LAST - ORIGIN) * (share - 0.5)


def slow_lookup(grid: Tensor, point: Tensor) -> Tensor:
    """Trilinear interpolation of one point by its eight corners, continued outside by the distance."""
    clamped = point.clamp(ORIGIN, LAST)
    position = (clamped - ORIGIN) / SPACING
    lower = [min(int(position[i]), COUNTS[i] - 2) for i in range(3)]
    total = torch.zeros(grid.shape[3:], dtype=grid.dtype)
    for corner in itertools.product((0, 1), repeat=3):
        weight = 1.0
        for i in range(3):
            fraction = float(position[i]) - lower[i]
            weight *= fraction if corner[i] else 1 - fraction
        total = total + weight * grid[lower[0] + corner[0], lower[1] + corner[1], lower[2] + corner[2]]
    return total if grid.ndim == 4 else total + (point - clamped).norm()


@pytest.mark.parametrize("num_codes", [0, 1, 3])
def test_value_and_derivatives_against_a_slow_loop(look_up: LookUp, num_codes: int) -> None:
    """Points in blocks, of which each has its object; some on nodes."""
    shape, at, (grid, basis) = random_shape(3, num_codes), points(), grids(3, num_codes)
    at[:2] = torch.stack([ORIGIN, ORIGIN + SPACING * torch.tensor([2.0, 1.0, 3.0])])
    owner = torch.tensor([0, 2, 1])
    blocks = at.view(3, 25, 3).movedim(-1, 0)
    found, values = look_up(shape, blocks, owner), shape.sdf(blocks, owner)
    for i, point in enumerate(at):
        value = slow_lookup(grid[owner[i // 25]], point)
        torch.testing.assert_close(found.value[i // 25, i % 25], value)
        torch.testing.assert_close(values[i // 25, i % 25], value)
        torch.testing.assert_close(found.J_value_code[i // 25, i % 25], slow_lookup(basis, point))


@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_gradient_is_the_derivative_of_the_value(look_up: LookUp, stretch: float) -> None:
    field, owner = random_shape(), torch.arange(2)
    at = points(40, stretch).mT.reshape(3, 2, 20).requires_grad_()
    (by_autograd,) = torch.autograd.grad(field.sdf(at, owner).sum(), at)
    found = look_up(field, at, owner)
    torch.testing.assert_close(found.gradient, by_autograd, rtol=1e-12, atol=1e-12)
    (other,) = torch.autograd.grad(found.value.sum(), at)
    torch.testing.assert_close(other, by_autograd, rtol=1e-12, atol=1e-12)
    if stretch == 1:  # no point is outside, which may be said
        within = field.derivatives(at, owner, inside=True)
        for mine, theirs in zip((*within, field.sdf(at, owner, inside=True)), (*found, found.value), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    else:
        torch.testing.assert_close(field.gradient(at, owner), found.gradient, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_shape_looks_up_packed_points(dtype: torch.dtype) -> None:
    shape, at, index = random_shape(dtype=dtype), points().to(dtype), torch.arange(75) % 2
    expected, found = shape.derivatives(at.mT[..., None], index), shape.value_and_derivatives(at, index)
    torch.testing.assert_close(found.value, expected.value[:, 0], rtol=0, atol=0)
    torch.testing.assert_close(found.gradient.mT, expected.gradient[..., 0], rtol=0, atol=0)
    torch.testing.assert_close(found.J_value_code, expected.J_value_code[:, 0], rtol=0, atol=0)
    rounding = 30 * torch.finfo(dtype).eps
    torch.testing.assert_close(shape.value(at, index), found.value, rtol=0, atol=rounding)
    with torch.no_grad():  # the basis vectors are added in another order
        torch.testing.assert_close(shape.value_and_derivatives(at, index)[2], found[2], rtol=0, atol=rounding)
    assert shape.value(at[:0], index[:0]).shape == (0,)


class Raised(GridShape):
    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        return super().value(points_obj, object_index) + 1


def test_terms_ask_a_class_made_of_grids_for_its_own_values() -> None:
    shape, blocks, owner = random_shape(3), points().view(3, 25, 3).movedim(-1, 0), torch.tensor([0, 2, 1])
    assert field_of(shape) is shape
    found = field_of(Raised(*shape)).sdf(blocks, owner)
    torch.testing.assert_close(found, shape.sdf(blocks, owner) + 1, rtol=1e-12, atol=1e-12)


def test_the_last_faces_belong_to_their_cells() -> None:
    shape, index = random_shape(1), torch.zeros(3, dtype=torch.long)
    shape = GridShape.of(shape.values, shape.basis, torch.zeros(3, dtype=torch.float64), 0.5)
    at = torch.tensor([[2.5, 0.7, 0.3], [0.2, 2.0, 0.3], [0.2, 0.3, 1.5]], dtype=torch.float64, requires_grad=True)
    (by_autograd,) = torch.autograd.grad(shape.value(at, index).sum(), at)
    torch.testing.assert_close(shape.value_and_derivatives(at, index).gradient, by_autograd)


@pytest.mark.parametrize("by", ["forward transform", "reverse transform", "dual numbers"])
def test_differentiation_needs_no_gradient_mode(by: str) -> None:
    """Where there is no distance from the grid, a derivative that takes it for a constant is NaN."""
    shape, at = random_shape(), points(20, 1.0)
    index, along = torch.arange(20) % 2, torch.ones(20, 3, dtype=torch.float64)
    expected = (shape.value_and_derivatives(at, index).gradient * along).sum(1)
    with torch.no_grad():
        if by == "dual numbers":
            with fwAD.dual_level():
                tangent = fwAD.unpack_dual(shape.value(fwAD.make_dual(at, along), index)).tangent
        elif by == "reverse transform":
            (gradient,) = torch.func.vjp(lambda x: shape.value(x, index), at)[1](torch.ones(20).double())
            tangent = (gradient * along).sum(1)
        else:
            _, tangent = torch.func.jvp(lambda x: shape.value(x, index), (at,), (along,))
    torch.testing.assert_close(tangent, expected, rtol=1e-12, atol=1e-12)


def test_the_gradient_can_be_traced() -> None:
    field, at, owner = random_shape(), points(20).mT.reshape(3, 2, 10), torch.arange(2)
    traced = torch.compile(field.gradient, backend="eager", fullgraph=True)
    torch.testing.assert_close(traced(at, owner), field.gradient(at, owner), rtol=1e-12, atol=1e-12)


OWNERS = torch.tensor([0, 2, 1])


def test_curvature_along_rays_by_differences() -> None:
    """Inside one cell, where the distance along a ray is a polynomial."""
    prior = ellipsoid_prior()
    shape = prior.bind(prior.initial_code(3))
    direction = torch.randn(3, 3, 64, dtype=torch.float64)
    # All rays pass the middles of cells at depth 1.
    middle = prior.origin + 0.2 * (torch.tensor([12.0, 6.0, 7.0]) + 0.5)
    centre = middle.view(3, 1, 1) - direction
    step = torch.tensor([-0.01, 0.0, 0.01], dtype=torch.float64).view(3, 1, 1)
    points = centre[:, None] + (1 + step) * direction[:, None]
    before, here, after = field_of(shape).sdf(points, OWNERS)
    depth = torch.ones(3, 64, dtype=torch.float64)
    for block in range(64):
        one = slice(block, block + 1)
        found = field_of(shape).curvature_along(OWNERS, centre[:, :, one], direction[:, :, one], depth[:, one])
        expected = ((before - 2 * here + after) / 0.01**2)[:, one]
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def box_sdf(
    half: tuple[float, float, float], centre: tuple[float, float, float], count: int = 25, spacing: float = 0.1
):
    x = torch.arange(count, dtype=torch.float64) * spacing - 0.5 * spacing * (count - 1)
    nodes = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1)
    q = (nodes - torch.tensor(centre, dtype=torch.float64)).abs() - torch.tensor(half, dtype=torch.float64)
    return q.clamp_min(0).norm(dim=-1) + q.amax(dim=-1).clamp_max(0), x[0].expand(3), spacing


def test_extents_of_boxes_between_nodes():
    # A box's field is linear across its faces, so the crossing is exact: centre -+ half size.
    boxes = [((0.33, 0.52, 0.71), (0.02, -0.07, 0.01)), ((0.61, 0.25, 0.4), (-0.11, 0.0, 0.13))]
    values = torch.stack([box_sdf(*box)[0] for box in boxes])
    _, origin, spacing = box_sdf(*boxes[0])
    expected = torch.tensor(
        [[[-0.31, -0.59, -0.70], [0.35, 0.45, 0.72]], [[-0.72, -0.25, -0.27], [0.50, 0.25, 0.53]]], dtype=torch.float64
    )
    torch.testing.assert_close(zero_level_extents(values, origin, spacing), expected, atol=1e-12, rtol=0)


def test_gradient_is_that_of_the_moving_surface():
    # Raising the field by e moves a face with unit gradient inwards by e: d upper / d e = -1, d lower / d e = +1.
    values, origin, spacing = box_sdf((0.33, 0.52, 0.71), (0.02, -0.07, 0.01))
    raise_by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    extents = zero_level_extents((values + raise_by)[None], origin, spacing)
    for corner, sign in ((0, 1.0), (1, -1.0)):
        (slope,) = torch.autograd.grad(extents[0, corner, 1], raise_by, retain_graph=True)
        assert slope.item() == pytest.approx(sign, abs=1e-9)


def test_no_crossing_gives_nan_and_leaves_the_others_alone():
    values, origin, spacing = box_sdf((0.33, 0.52, 0.71), (0.0, 0.0, 0.0))
    both = zero_level_extents(torch.stack([values.abs() + 1, values]), origin, spacing)
    assert both[0].isnan().all()
    torch.testing.assert_close(both[1], zero_level_extents(values[None], origin, spacing)[0])


def test_extents_of_nothing_and_wrong_shapes():
    assert zero_level_extents(torch.zeros(0, 4, 4, 4), torch.zeros(3), 0.1).shape == (0, 2, 3)
    with pytest.raises(InputError, match="values: expected shape"):
        zero_level_extents(torch.zeros(4, 4, 4), torch.zeros(3), 0.1)


@pytest.mark.parametrize("counts", [(1, 3, 3), (3, 1, 3), (3, 3, 1)])
def test_grids_of_one_layer_are_refused(counts: tuple[int, int, int]) -> None:
    with pytest.raises(InputError, match="basis: expected at least two nodes along each axis"):
        GridShape.of(torch.zeros(1, *counts), torch.zeros(*counts, 2), torch.zeros(3), SPACING)
