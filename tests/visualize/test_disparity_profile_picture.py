"""Pictures of disparity profiles."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
import torch

from directshape_torch.diagnosis.disparity_profile import DisparityProfile, profile_offsets
from directshape_torch.errors import InputError
from directshape_torch.visualize.disparity_profile_picture import write_profile_picture


def _profile(count: int, minimum_px: float = 0.5) -> DisparityProfile:
    offsets = profile_offsets()
    curves = (5 + (offsets - minimum_px) ** 2).expand(count, -1).clone()
    return DisparityProfile(offsets, 2 * curves, curves, torch.full((count,), 50.0, dtype=torch.float64))


def test_equal_curves_give_equal_bytes_and_others_do_not(tmp_path: Path) -> None:
    for name, minimum in (("a", 0.5), ("b", 0.5), ("c", -1.0)):
        write_profile_picture(tmp_path / name, _profile(1, minimum), ["a car"], "cars")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a").read_bytes() != (tmp_path / "c").read_bytes()


def test_every_car_has_its_place_also_without_a_curve(tmp_path: Path) -> None:
    three = _profile(3)
    three.cost_after[1] = torch.nan
    three.cost_before[1] = torch.nan
    write_profile_picture(tmp_path / "1.png", _profile(1), ["a"], "cars")
    write_profile_picture(tmp_path / "3.png", three, ["a", "b", "c"], "cars")
    one, many = (cv2.imread(str(tmp_path / f"{count}.png")) for count in (1, 3))
    assert many.shape[1] == pytest.approx(3 * one.shape[1], abs=2)


def test_a_name_too_few_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one for each of 2"):
        write_profile_picture(tmp_path / "x.png", _profile(2), ["a"], "cars")
