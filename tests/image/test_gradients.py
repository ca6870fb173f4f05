"""Grey levels and the length of gradients against hand-derived numbers and OpenCV."""

from __future__ import annotations

import cv2
import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.image.grey_levels import grey_levels, length_2d


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
