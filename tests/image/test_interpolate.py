"""Bilinear lookups agree with numbers by hand, a reference and autograd, at borders, in padding, in mixed sizes."""

from __future__ import annotations

import torch
from helpers.lookup import bilinear_with_gradient
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from directshape_torch.image.interpolate import BilinearPatch, bilinear_patch


def random_images(seed: int, shape: tuple[int, int, int], dtype: torch.dtype = torch.float64) -> Tensor:
    return 255 * torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def random_uv(seed: int, shape: tuple[int, ...], height: int, width: int) -> Tensor:
    unit = torch.rand((*shape, 2), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return unit * torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64)


def test_hand_derived_cell() -> None:
    # f(u, v) = 1 (1-u)(1-v) + 5 u (1-v) + 11 (1-u) v + 31 u v at u = 0.25, v = 0.5:
    # value = 0.375 + 0.625 + 4.125 + 3.875 = 9; df/du = 4 * 0.5 + 20 * 0.5 = 12; df/dv = 10 * 0.75 + 26 * 0.25 = 14.
    image = torch.tensor([[[1.0, 5.0], [11.0, 31.0]]], dtype=torch.float64)
    value, gradient, inside = bilinear_with_gradient(image, torch.tensor([0]), torch.tensor([[0.25, 0.5]]).double())
    assert value.item() == 9.0
    assert gradient.tolist() == [[12.0, 14.0]]
    assert inside.tolist() == [True]


def test_equals_grid_sample() -> None:
    images = random_images(1, (3, 7, 9))
    uv = random_uv(2, (3, 50), 7, 9)
    value, _, _ = bilinear_with_gradient(images, torch.arange(3)[:, None], uv)
    grid = (2 * uv / torch.tensor([8.0, 6.0], dtype=torch.float64) - 1)[:, None]
    expected = torch.nn.functional.grid_sample(images[:, None], grid, align_corners=True)[:, 0, 0]
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-10)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), height=st.integers(1, 6), width=st.integers(1, 6), padding=st.sampled_from([0, 3]))
def test_gradient_is_autograds(seed: int, height: int, width: int, padding: int) -> None:
    images = random_images(seed, (2, height + padding, width + padding))
    sizes = torch.tensor([[height, width]] * 2) if padding else None
    # A third of the points outside, so that the clamped derivative is compared too.
    uv = 1.5 * random_uv(seed + 1, (2, 30), height + 1, width + 1) - 0.5
    # And at the first and the last centre, where a clamp may halve or lose it.
    uv[:, :2] = torch.tensor([[0, 0], [width - 1, height - 1]])
    uv.requires_grad_()
    value, gradient, _ = bilinear_with_gradient(images, torch.arange(2)[:, None], uv, sizes)
    (from_autograd,) = torch.autograd.grad(value.sum(), uv)
    torch.testing.assert_close(gradient, from_autograd, rtol=0, atol=1e-9)


def test_outside_is_clamped_flagged_and_flat() -> None:
    image = torch.tensor([[[1.0, 2.0], [5.0, 9.0]]], dtype=torch.float64)
    uv = torch.tensor([[-3.0, 0.5], [9.0, 0.5], [0.5, -1.0], [0.5, 4.0], [torch.inf, -torch.inf]], dtype=torch.float64)
    value, gradient, inside = bilinear_with_gradient(image, torch.zeros(5, dtype=torch.long), uv)
    assert not inside.any()
    assert value.tolist() == [3.0, 5.5, 1.5, 7.0, 2.0]
    # Along the clamped coordinate the lookup is constant, along the other it is not.
    assert gradient.tolist() == [[0.0, 4.0], [0.0, 7.0], [1.0, 0.0], [4.0, 0.0], [0.0, 0.0]]


SIZES = [(4, 5), (1, 6), (3, 1), (1, 1), (7, 3)]


def _images() -> list[Tensor]:
    generator = torch.Generator().manual_seed(3)
    return [255 * torch.rand(*size, generator=generator, dtype=torch.float64) for size in SIZES]


def _together(images: list[Tensor], u: Tensor, v: Tensor) -> BilinearPatch:
    """A lookup of row i of the coordinates in image i, with the images stored one after another without padding."""
    pixels = torch.cat([image.flatten() for image in images])
    first = torch.tensor([0, *(image.numel() for image in images[:-1])]).cumsum(0)
    height, width = torch.tensor([image.shape for image in images]).unbind(1)
    last_column, last_row = (width - 1)[:, None], (height - 1)[:, None]
    return bilinear_patch(pixels, first[:, None], width[:, None], u, v, last_column, last_row)


def test_images_of_different_sizes_in_a_row() -> None:
    images, generator = _images(), torch.Generator().manual_seed(4)
    u, v = (9 * torch.rand(2, len(images), 60, generator=generator, dtype=torch.float64) - 1.5).unbind(0)
    u[:, :7] = u[:, :7].round()
    v[:, 3:9] = v[:, 3:9].round()
    u[:, 0], v[:, 0] = 0.0, 0.0
    found = _together(images, u, v)
    for i, image in enumerate(images):
        uv = torch.stack([u[i], v[i]], dim=-1)
        value, gradient, inside = bilinear_with_gradient(image[None], torch.zeros(60, dtype=torch.long), uv)
        assert torch.equal(found.value[i], value)
        assert torch.equal(torch.stack([found.d_u[i], found.d_v[i]], dim=-1), gradient)
        assert torch.equal(found.inside[i], inside)
    assert found.inside.any(dim=1).all()
    assert (~found.inside).any(dim=1).all()


def test_coordinates_that_are_not_finite_are_outside() -> None:
    images = _images()
    u = torch.full((len(images), 3), 0.0, dtype=torch.float64)
    u[:, 0], u[:, 1], u[:, 2] = torch.nan, torch.inf, -torch.inf
    found = _together(images, u, torch.zeros_like(u))
    assert not found.inside.any()
    assert found.value.isfinite().all()
    assert (found.d_u == 0).all()
