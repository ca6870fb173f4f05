"""The sampled pixels of a region agree with hand-made cases, properties, and the plain form of the reference."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.observation.packing import sampled_pixels

SIZES = torch.tensor([[70, 150], [64, 101]])


def noise(seed: int) -> Tensor:
    """Two padded frames of noise."""
    return torch.rand(2, 3, 70, 150, generator=torch.Generator().manual_seed(seed))


@given(width=st.integers(0, 300), height=st.integers(0, 200), wanted=st.integers(1, 900))
def test_even_pixels_lie_in_the_region_each_once_and_about_as_many_as_are_wanted(
    width: int, height: int, wanted: int
) -> None:
    settings = SamplingConfig(min_pixels=wanted, max_pixels=wanted)
    region = torch.tensor([[5, 6, 5 + width, 6 + height]])
    _, uv = sampled_pixels(noise(0), SIZES, torch.tensor([0]), region, "uniform", settings)
    assert ((uv >= region[:, :2]) & (uv < region[:, 2:])).all()
    assert len(uv.unique(dim=0)) == len(uv)
    if min(width, height) ** 2 > 100 * max(1, width * height / wanted):
        assert len(uv) == pytest.approx(min(wanted, width * height), rel=0.25)


def test_strong_gradients_are_found() -> None:
    images = torch.zeros(1, 3, 40, 40)
    images[..., 20:] = 1.0  # an edge between columns 19 and 20
    settings = SamplingConfig(min_pixels=4, max_pixels=4)
    arguments = torch.tensor([[40, 40]]), torch.tensor([0]), torch.tensor([[4, 4, 36, 36]]), "adaptive", settings
    # In both columns of cells the pixels beside the edge, the uppermost of equals.
    assert sampled_pixels(images, *arguments)[1].tolist() == [[19, 4], [20, 4], [19, 20], [20, 20]]
    assert torch.equal(sampled_pixels(images.double(), *arguments)[1], sampled_pixels(images, *arguments)[1])


def test_a_nan_image_still_gives_pixels_and_touches_no_other_frame() -> None:
    images = noise(3)
    spoiled = images.clone()
    spoiled[0] = torch.nan
    arguments = SIZES, torch.tensor([0, 1]), torch.tensor([[0, 0, 50, 50]] * 2), "adaptive", SamplingConfig()
    (of, uv), (clean_of, clean_uv) = sampled_pixels(spoiled, *arguments), sampled_pixels(images, *arguments)
    assert (of == 0).any()
    assert torch.equal(uv[of == 1], clean_uv[clean_of == 1])
