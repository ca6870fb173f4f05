"""Parts of frames against the same pixels of whole frames."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.image.frame_parts import gradient_magnitude_at, gradient_magnitude_of_part
from directshape_torch.image.gradients import gradient_magnitude, grey_levels, image_gradient

# Of a frame of 41 x 33 pixels: inside, along each edge, in corners, single pixels, all of it.
PARTS = [(5, 6, 20, 31), (0, 6, 4, 9), (30, 2, 33, 8), (3, 0, 9, 2), (3, 40, 9, 41), (0, 0, 1, 1), (32, 40, 33, 41),
         (0, 0, 33, 41)]  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_a_part_are_those_of_the_frame(part: tuple[int, int, int, int], dtype: torch.dtype) -> None:
    images = torch.rand(1, 3, 50, 70, generator=torch.Generator().manual_seed(0), dtype=dtype)
    whole = gradient_magnitude(image_gradient(grey_levels(images), torch.tensor([[41, 33]])))
    u0, v0, u1, v1 = part
    got = gradient_magnitude_of_part(images[0], (41, 33), part)
    assert torch.equal(got, whole[0, v0:v1, u0:u1])


def test_a_frame_of_one_pixel_is_flat() -> None:
    assert gradient_magnitude_of_part(torch.rand(3, 4, 4), (1, 1), (0, 0, 1, 1)).tolist() == [[0.0]]


def test_derivatives_by_the_image_are_exact() -> None:
    image = torch.rand(3, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: gradient_magnitude_of_part(x, (5, 7), (0, 1, 4, 5)), image)


def test_where_an_image_is_flat_the_derivative_is_zero() -> None:
    image = torch.full((3, 5, 5), 0.5, requires_grad=True)
    gradient_magnitude_of_part(image, (5, 5), (1, 1, 4, 4)).sum().backward()
    assert image.grad is not None
    assert image.grad.abs().max() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_pixels_are_those_of_the_frames(dtype: torch.dtype) -> None:
    images = torch.rand(2, 3, 50, 70, generator=torch.Generator().manual_seed(0), dtype=dtype)
    sizes = torch.tensor([[41, 33], [50, 70]])
    whole = gradient_magnitude(image_gradient(grey_levels(images), sizes))
    for frame, (height, width) in enumerate(sizes.tolist()):
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        uv = torch.stack([u, v], dim=-1).reshape(-1, 2)
        for given in (images, images.contiguous(memory_format=torch.channels_last)):
            got = gradient_magnitude_at(given, sizes, torch.full((len(uv),), frame), uv)
            assert torch.equal(got.view(height, width), whole[frame, :height, :width])


def test_derivatives_at_pixels_by_the_images_are_exact() -> None:
    images = torch.rand(2, 3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    sizes, frame, uv = torch.tensor([[4, 5], [3, 4]]), torch.tensor([0, 1, 1]), torch.tensor([[4, 0], [3, 2], [1, 1]])
    assert torch.autograd.gradcheck(lambda x: gradient_magnitude_at(x, sizes, frame, uv), images)
