"""These tests check the disparity field: its basis, bounded continuation, file, and refusal of other rigs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField, nearest_in_convex_polygon, polynomial_basis

SIZE = (1242, 375)


def rig() -> tuple[Tensor, Tensor, Tensor]:
    K = torch.tensor([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]], dtype=torch.float64)
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[:3, 3] = torch.tensor([-0.5327, 0.0027, 0.0])
    return K, K.clone(), T_right_cam


def smooth_field(hull: list[list[float]] | None = None) -> DisparityField:
    coefficients = torch.tensor([-0.3, 0.1, 0.2, -0.6, 0.05, 0.1, -0.2, 0.3, 0.1, -0.4], dtype=torch.float64)
    hull_uv = torch.tensor(hull or [[0, 0], [1241, 0], [1241, 374], [0, 374]], dtype=torch.float64)
    return DisparityField(coefficients, hull_uv, SIZE, *rig())


def test_basis_at_a_hand_computed_pixel() -> None:
    # In an image of 5 x 3 pixels, (3, 0) is normalised to (0.5, -1).
    basis = polynomial_basis(torch.tensor([3.0, 0.0], dtype=torch.float64), (5, 3))
    assert basis.tolist() == [1, 0.5, -1, 0.25, -0.5, 1, 0.125, -0.25, 0.5, 0.0625]


@settings(max_examples=30, deadline=None)
@given(angle=st.floats(0, 6.28), clockwise=st.booleans())
def test_nearest_point_of_a_polygon_agrees_with_dense_sampling_of_its_border(angle: float, clockwise: bool) -> None:
    polygon = torch.tensor([[0, 0], [10, 1], [12, 6], [4, 9]], dtype=torch.float64)
    polygon = polygon.flip(0) if clockwise else polygon
    point = torch.tensor([6.0, 4.0]) + 15 * torch.tensor([angle, angle - torch.pi / 2], dtype=torch.float64).cos()
    t = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None, None]
    border = (polygon + t * (polygon.roll(-1, 0) - polygon)).reshape(-1, 2)
    expected = border[(border - point).norm(dim=-1).argmin()]
    torch.testing.assert_close(nearest_in_convex_polygon(point, polygon), expected, atol=0.01, rtol=0)


def test_both_offsets_of_pixels_in_and_out_of_the_hull() -> None:
    vertical = torch.tensor([0.1, -0.2, 0.3, 0.0, 0.1, 0.2, -0.1, 0.0, 0.3, 0.2], dtype=torch.float64)
    field = replace(
        smooth_field([[300.0, 100.0], [900.0, 100.0], [900.0, 300.0], [300.0, 300.0]]), vertical_coefficients=vertical
    )
    uv = torch.tensor([[400.0, 200.0], [0.0, 200.0], [300.0, 100.0], [torch.nan, 0.0], [950.0, 350.0], [899.0, 101.0]])
    uv = uv.double().view(3, 2, 2)
    nearest = torch.stack([uv[..., 0].clamp(300, 900), uv[..., 1].clamp(100, 300)], dim=-1)
    expected = polynomial_basis(nearest, SIZE)
    bias, rows = field.offsets(uv)
    known = ~uv.isnan().any(dim=-1)
    torch.testing.assert_close(bias[known], (expected @ field.coefficients)[known])
    torch.testing.assert_close(rows[known], (expected @ vertical)[known])
    assert torch.equal(field.bias(uv)[known], bias[known])
    assert torch.equal(field.offsets(uv)[1][known], rows[known])
    other_way_round = replace(field, hull_uv=field.hull_uv.flip(0))
    torch.testing.assert_close(other_way_round.bias(uv)[known], bias[known])
    assert bool(bias.isnan().view(-1)[3])


def test_pixel_by_pixel_under_a_transform() -> None:
    """Which pixels are outside cannot be asked there."""
    field = smooth_field([[300.0, 100.0], [900.0, 100.0], [900.0, 300.0], [300.0, 300.0]])
    uv = torch.tensor([[400.0, 200.0], [0.0, 200.0], [950.0, 350.0]], dtype=torch.float64)
    torch.testing.assert_close(torch.func.vmap(field.bias)(uv), field.bias(uv))


def test_a_polygon_of_more_digits_than_the_points() -> None:
    square = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]], dtype=torch.float64)
    nearest = nearest_in_convex_polygon(torch.tensor([[1.0, 2.0], [9.0, 2.0]]), square)
    assert nearest.tolist() == [[1.0, 2.0], [4.0, 2.0]]


def test_same_rig_passes_even_in_float32() -> None:
    smooth_field().check_rig(SIZE, *(t.float() for t in rig()))


@pytest.mark.parametrize(
    ("index", "entry", "change", "text"),
    [
        (0, (0, 0), 2.7, "K_left"),
        (1, (0, 2), -0.2, "K_right"),
        (2, (0, 3), 0.005, "T_right_cam"),
        (2, (0, 1), 5e-4, "rig.s rotation to"),
    ],
)
def test_another_rig_is_refused(index: int, entry: tuple[int, int], change: float, text: str) -> None:
    matrices = [t.clone() for t in rig()]
    matrices[index][entry] += change
    with pytest.raises(InputError, match=text):
        smooth_field().check_rig(SIZE, *matrices)


def test_another_image_size_is_refused() -> None:
    with pytest.raises(InputError, match=r"1242 x 375.*1224 x 370.*calibrate-rig"):
        smooth_field().check_rig((1224, 370), *rig())


def test_wrong_tensors_are_refused() -> None:
    K_left, K_right, T_right_cam = rig()
    with pytest.raises(InputError, match="coefficients"):
        DisparityField(torch.zeros(9), torch.zeros(4, 2), SIZE, K_left, K_right, T_right_cam)
    with pytest.raises(InputError, match="hull_uv"):
        DisparityField(torch.zeros(10), torch.zeros(2, 2), SIZE, K_left, K_right, T_right_cam)
    with pytest.raises(InputError, match="finite"):
        DisparityField(torch.full((10,), torch.nan), torch.zeros(3, 2), SIZE, K_left, K_right, T_right_cam)
