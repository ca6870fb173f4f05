"""Grey levels and image gradients against hand-derived numbers and analytic images."""

from __future__ import annotations

import cv2
import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.image.gradients import gradient_magnitude, grey_levels, image_gradient


def test_grey_levels_of_the_primaries() -> None:
    primaries = torch.eye(3, dtype=torch.float64).reshape(3, 3, 1, 1)
    expected = torch.tensor([76.245, 149.685, 29.07], dtype=torch.float64)  # 255 * (0.299, 0.587, 0.114)
    torch.testing.assert_close(grey_levels(primaries).flatten(), expected, rtol=0, atol=1e-12)


def test_grey_levels_match_opencv() -> None:
    rgb = torch.randint(0, 256, (5, 6, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    expected = torch.from_numpy(cv2.cvtColor(rgb.numpy(), cv2.COLOR_RGB2GRAY)).float()
    got = grey_levels(rgb.permute(2, 0, 1)[None] / 255)[0]
    assert (got - expected).abs().max() <= 0.5 + 1e-3  # OpenCV rounds to whole levels


def test_gradient_of_a_quadratic_is_exact_inside() -> None:
    # Central differences are exact for u^2 + 3 u v: d/du = 2 u + 3 v, d/dv = 3 u.
    v, u = torch.meshgrid(torch.arange(5.0), torch.arange(6.0), indexing="ij")
    gradient = image_gradient((u * u + 3 * u * v)[None].double())[0]
    torch.testing.assert_close(gradient[0, :, 1:-1], (2 * u + 3 * v)[:, 1:-1].double())
    torch.testing.assert_close(gradient[1, 1:-1], 3 * u[1:-1].double())


def test_border_is_replicated() -> None:
    gradient = image_gradient(torch.tensor([[[0.0, 6.0, 8.0], [10.0, 16.0, 18.0]]]))
    assert gradient[0, 0].tolist() == [[3.0, 4.0, 1.0], [3.0, 4.0, 1.0]]
    assert gradient[0, 1].tolist() == [[5.0, 5.0, 5.0], [5.0, 5.0, 5.0]]


def test_padding_changes_nothing_inside() -> None:
    grey = torch.rand(2, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    padded = torch.full((2, 7, 9), 1e6, dtype=torch.float64)
    padded[0, :4, :5] = grey[0]
    padded[1, :3, :4] = grey[1, :3, :4]
    got = image_gradient(padded, torch.tensor([[4, 5], [3, 4]]))
    torch.testing.assert_close(got[0, :, :4, :5], image_gradient(grey[:1])[0], rtol=0, atol=0)
    torch.testing.assert_close(got[1, :, :3, :4], image_gradient(grey[1:, :3, :4])[0], rtol=0, atol=0)


def test_magnitude_and_shapes() -> None:
    gradient = torch.tensor([[3.0, -5.0], [4.0, 12.0]], dtype=torch.float64).reshape(1, 2, 1, 2)
    assert gradient_magnitude(gradient).tolist() == [[[5.0, 13.0]]]
    for num_frames in (0, 1, 3):
        grey = grey_levels(torch.zeros(num_frames, 3, 4, 5))
        assert image_gradient(grey).shape == (num_frames, 2, 4, 5)
        assert gradient_magnitude(image_gradient(grey)).shape == (num_frames, 4, 5)
    assert image_gradient(torch.ones(1, 1, 1)).abs().max() == 0


def test_flat_images_have_a_derivative() -> None:
    grey = torch.tensor([[[1.0, 1.0, 1.0, 4.0]]], requires_grad=True)
    gradient_magnitude(image_gradient(grey)).sum().backward()
    assert grey.grad is not None
    # |d/du| is 0, 0, 1.5, 1.5: the flat ones pull at nothing.
    assert grey.grad.tolist() == [[[0.0, -0.5, -0.5, 1.0]]]


def test_what_is_not_finite_has_no_derivative() -> None:
    """Nor spoils that of the pixels beside it, which look at it as little as at the rest of the image."""
    grey = torch.tensor([[[1.0, 2.0, 4.0, 4.0, torch.nan, torch.inf, 3.0]]], requires_grad=True)
    magnitude = gradient_magnitude(image_gradient(grey))
    assert magnitude.detach().isfinite().flatten().tolist() == [True, True, True, False, False, False, False]
    torch.where(magnitude.isfinite(), magnitude, 0).sum().backward()
    assert grey.grad is not None
    assert grey.grad.tolist() == [[[-1.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0]]]


def test_wrong_input_is_named() -> None:
    with pytest.raises(InputError, match=r"images: expected shape \(F, 3, H, W\), got \(2, 4, 5\)"):
        grey_levels(torch.zeros(2, 4, 5))
    with pytest.raises(InputError, match="divide by 255"):
        grey_levels(torch.zeros(1, 3, 4, 5, dtype=torch.uint8))
    with pytest.raises(InputError, match="call grey_levels first"):
        image_gradient(torch.zeros(1, 3, 4, 5))
