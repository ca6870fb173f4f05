"""Lookups with coordinates apart and images of different sizes in a row, against one image at a time."""

from __future__ import annotations

import torch
from helpers.lookup import bilinear_with_gradient
from torch import Tensor

from directshape_torch.image.interpolate import BilinearPatch, bilinear_patch

SIZES = [(4, 5), (1, 6), (3, 1), (1, 1), (7, 3)]


def _images() -> list[Tensor]:
    generator = torch.Generator().manual_seed(3)
    return [255 * torch.rand(*size, generator=generator, dtype=torch.float64) for size in SIZES]


def _together(images: list[Tensor], u: Tensor, v: Tensor) -> BilinearPatch:
    """Row i of the coordinates in image i, the images behind one another without padding."""
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
