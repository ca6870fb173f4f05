"""The sheet of one car shows both rounds and the occluder, and asks for a car with a mask."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.synthetic_scene import cached_street, select

from directshape_torch.errors import InputError
from directshape_torch.visualize.observation_sheet import observation_sheet


def test_the_sheet_has_green_and_red_samples() -> None:
    scene = cached_street(torch.float32)[1]
    sheet = observation_sheet(scene.frames, scene.detections, 0)
    assert sheet.dtype == np.uint8
    assert sheet.shape[0] == 350
    # The legend: a dot of each colour below the panels.
    dots = {tuple(colour) for colour in sheet[320:].reshape(-1, 3).tolist()}
    assert {(0, 230, 0), (255, 40, 40), (255, 220, 0), (70, 130, 255), (255, 255, 255)} <= dots
    sheet = sheet[:320]
    red, green, blue = (sheet[..., k].astype(int) for k in range(3))
    assert ((green > 150) & (red < 100) & (blue < 100)).sum() > 20
    assert ((red > 150) & (green < 100) & (blue < 100)).sum() > 20


def test_a_car_that_is_not_there_is_refused() -> None:
    scene = cached_street(torch.float32)[1]
    with pytest.raises(InputError):
        observation_sheet(scene.frames, select(scene.detections, torch.tensor([0])), 3)
