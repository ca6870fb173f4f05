"""Grey levels, gradients of frames, parts and pixels, and pyramids agree with numbers by hand, OpenCV and kornia."""

from __future__ import annotations

import cv2
import pytest
import torch
from kornia.filters import spatial_gradient
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.image.grey_levels import (
    gradient_magnitude_at,
    gradient_magnitude_of_part,
    grey_levels,
    halve,
    halve_sizes,
    length_2d,
)


def test_grey_levels_match_opencv() -> None:
    rgb = torch.randint(0, 256, (5, 6, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    expected = torch.from_numpy(cv2.cvtColor(rgb.numpy(), cv2.COLOR_RGB2GRAY)).float()
    got = grey_levels(rgb.permute(2, 0, 1)[None] / 255)[0]
    assert (got - expected).abs().max() <= 0.5 + 1e-3  # OpenCV rounds to whole levels


def test_flat_images_have_a_derivative() -> None:
    d_u, d_v = (torch.tensor(d, requires_grad=True) for d in ([0.0, 3.0], [0.0, 4.0]))
    length = length_2d(d_u, d_v)
    assert length.tolist() == [0.0, 5.0]
    length.sum().backward()
    assert d_u.grad is not None
    torch.testing.assert_close(d_u.grad, torch.tensor([0.0, 0.6]))


def test_what_is_not_finite_has_no_derivative() -> None:
    """0 and not NaN."""
    d_u = torch.tensor([1.0, torch.nan, torch.inf], requires_grad=True)
    length = length_2d(d_u, torch.zeros(3))
    assert length.detach().isfinite().tolist() == [True, False, False]
    torch.where(length.isfinite(), length, 0).sum().backward()
    assert d_u.grad is not None
    assert d_u.grad.tolist() == [1.0, 0.0, 0.0]


def test_wrong_input_is_named() -> None:
    with pytest.raises(InputError, match=r"images: expected shape \(\*, 3, H, W\), got \(2, 4, 5\)"):
        grey_levels(torch.zeros(2, 4, 5))
    with pytest.raises(InputError, match="divide by 255"):
        grey_levels(torch.zeros(1, 3, 4, 5, dtype=torch.uint8))


# Of a frame of 41 x 33 pixels: inside, along each edge, in corners, single pixels, all of it.
PARTS = [(5, 6, 20, 31), (0, 6, 4, 9), (30, 2, 33, 8), (3, 0, 9, 2), (3, 40, 9, 41), (0, 0, 1, 1), (32, 40, 33, 41),
         (0, 0, 33, 41)]  # fmt: skip


def by_kornia(
    image: Tensor,  # (3, H, W)
    size_hw: tuple[int, int],
) -> Tensor:
    """Values of one frame without its padding, (height, width)."""
    height, width = size_hw
    grey = grey_levels(image[None, :, :height, :width])
    return length_2d(*spatial_gradient(grey[None], mode="diff")[0, 0])


def test_gradient_magnitudes_by_hand() -> None:
    """d/du = 3, 4, 1 by the replicated border, and d/dv = 5."""
    grey = torch.tensor([[0.0, 6.0, 8.0], [10.0, 16.0, 18.0]], dtype=torch.float64)
    magnitude = gradient_magnitude_of_part((grey / 255).expand(3, 2, 3), (2, 3), (0, 0, 3, 2))
    expected = torch.tensor([34.0, 41.0, 26.0], dtype=torch.float64).sqrt().expand(2, 3)
    torch.testing.assert_close(magnitude, expected)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_a_part_are_those_of_the_frame(part: tuple[int, int, int, int], dtype: torch.dtype) -> None:
    images = torch.rand(1, 3, 50, 70, generator=torch.Generator().manual_seed(0), dtype=dtype)
    u0, v0, u1, v1 = part
    got = gradient_magnitude_of_part(images[0], (41, 33), part)
    assert torch.equal(got, by_kornia(images[0], (41, 33))[v0:v1, u0:u1])


def test_derivatives_by_the_image_are_exact() -> None:
    image = torch.rand(3, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: gradient_magnitude_of_part(x, (5, 7), (0, 1, 4, 5)), image)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_pixels_are_those_of_the_frames(dtype: torch.dtype) -> None:
    images = torch.rand(2, 3, 50, 70, generator=torch.Generator().manual_seed(0), dtype=dtype)
    sizes = torch.tensor([[41, 33], [50, 70]])
    for frame, (height, width) in enumerate(sizes.tolist()):
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        uv = torch.stack([u, v], dim=-1).reshape(-1, 2)
        for given in (images, images.contiguous(memory_format=torch.channels_last)):
            got = gradient_magnitude_at(given, sizes, torch.full((len(uv),), frame), uv)
            assert torch.equal(got.view(height, width), by_kornia(images[frame], (height, width)))


def test_derivatives_at_pixels_by_the_images_are_exact() -> None:
    images = torch.rand(2, 3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    sizes, frame, uv = torch.tensor([[4, 5], [3, 4]]), torch.tensor([0, 1, 1]), torch.tensor([[4, 0], [3, 2], [1, 1]])
    assert torch.autograd.gradcheck(lambda x: gradient_magnitude_at(x, sizes, frame, uv), images)


def test_odd_last_row_and_column_are_dropped() -> None:
    images = torch.arange(15.0).reshape(1, 1, 3, 5)
    assert halve(images).tolist() == [[[[3.0, 5.0]]]]  # (0+1+5+6)/4, (2+3+7+8)/4
    assert halve_sizes(torch.tensor([[3, 5], [1, 4]])).tolist() == [[1, 2], [1, 2]]


def test_a_coarse_pixel_lies_between_two_fine_ones() -> None:
    # A linear image shows where a point goes: pixel u of the full image carries the value u.
    ramp = torch.arange(1242.0, dtype=torch.float64).repeat(1, 1, 4, 1)
    coarse = halve(ramp)[0, 0, 0]
    torch.testing.assert_close(coarse, 2 * torch.arange(621.0, dtype=torch.float64) + 0.5)


def test_no_images_and_errors() -> None:
    assert halve(torch.zeros(0, 3, 9, 16)).shape == (0, 3, 4, 8)
    with pytest.raises(InputError, match="use fewer levels"):
        halve(torch.zeros(1, 3, 4, 1))
