"""Disparity maps of frames: those that they bring, OpenCV's, and those of an optional package."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.exact_disparity import measured_street
from helpers.synthetic_scene import cached_street, joined_frames
from numpy.typing import NDArray

from directshape_torch.errors import InputError, MissingDependencyError
from directshape_torch.stereo_matching.disparity import match_disparity_elas, with_disparity


def test_frames_keep_the_disparity_that_they_bring() -> None:
    frames = measured_street()[1].frames
    assert with_disparity(frames, "sgbm") is frames


def test_matching_finds_the_cars_of_every_frame_and_leaves_the_padding_alone() -> None:
    truth = measured_street()[1].frames.disparity
    frame = cached_street()[1].frames
    bigger = replace(
        frame,
        images_left=torch.nn.functional.pad(frame.images_left, (0, 9, 0, 5)),
        images_right=torch.nn.functional.pad(frame.images_right, (0, 9, 0, 5)),
    )
    found = with_disparity(joined_frames([frame, bigger]), "sgbm").disparity
    assert found is not None
    assert truth is not None
    assert found.shape == (2, 125, 169)
    assert found.dtype == frame.images_left.dtype
    assert found[:, 120:].isnan().all()
    assert found[:, :, 160:].isnan().all()
    torch.testing.assert_close(found[1], found[0], equal_nan=True)
    error = (found[:1, :120, :160] - truth)[truth.isfinite()]
    assert error.isfinite().double().mean() > 0.5
    assert error[error.isfinite()].abs().median() < 0.3


def test_only_frames_that_are_needed_are_matched() -> None:
    frame = cached_street()[1].frames
    frames = joined_frames([frame, frame])
    every = with_disparity(frames, "sgbm").disparity
    one = with_disparity(frames, "sgbm", needed=torch.tensor([1, 1])).disparity
    none = with_disparity(frames, "sgbm", needed=torch.zeros(0, dtype=torch.long)).disparity
    assert every is not None
    assert one is not None
    assert none is not None
    torch.testing.assert_close(one[1], every[1], rtol=0, atol=0, equal_nan=True)
    assert one[0].isnan().all()
    assert none.isnan().all()


def test_elas_is_asked_for_by_name_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "elas", None)
    with pytest.raises(
        MissingDependencyError, match=r"matcher elas .*pyelas.; .*CPLUS_INCLUDE_PATH=\S*include pip .*\[elas\]"
    ):
        with_disparity(cached_street()[1].frames, "elas")


def test_elas_checks_the_pair_first() -> None:
    grey = np.zeros((20, 30), np.uint8)
    with pytest.raises(InputError, match="image_left: expected an RGB image"):
        match_disparity_elas(grey, grey)


@pytest.mark.skipif(importlib.util.find_spec("elas") is None, reason="the optional package pyelas is not installed")
def test_elas_finds_a_constant_disparity() -> None:
    texture: NDArray[np.uint8] = np.random.default_rng(0).integers(0, 255, (120, 240, 3), dtype=np.uint8)
    found = match_disparity_elas(texture, np.roll(texture, -8, axis=1))
    assert found.shape == (120, 240)
    assert np.nanmedian(found[20:-20, 40:-20]) == pytest.approx(8.0, abs=0.2)
