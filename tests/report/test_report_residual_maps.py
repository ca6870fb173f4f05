"""Residual maps on the ray-cast street: nothing at the truth, the right sign and place away from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.synthetic_scene import cached_street
from hypothesis import example, given
from hypothesis import strategies as st

from directshape_torch.io.config_files import load_config
from directshape_torch.report.residual_maps import Floats, residual_maps
from directshape_torch.visualize.drawing import View, pixel_grid

SHARP = load_config(None, ["stages=[{contour_width_px: 0.25}]"])
WINDOW_MARGIN_PX = 6


def maps(shift_m: tuple[float, float, float] = (0, 0, 0), **changes: object) -> tuple[Floats, Floats | None]:
    prior, street = cached_street(torch.float32)
    T = street.detections.T_cam_obj[0].double().numpy().copy()
    T[:3, 3] += shift_m
    given = {
        "foreground": street.detections.mask_left[0].float().numpy(),
        "hidden": np.zeros(street.detections.mask_left.shape[1:], dtype=np.bool_),
        "config": SHARP,
        **changes,
    }
    code = street.code[0].double().numpy()
    return residual_maps(street.frames, prior, T, code, window(), **given)  # type: ignore[arg-type]


def window() -> tuple[int, int, int, int]:
    _, street = cached_street(torch.float32)
    rows, columns = street.detections.mask_left[0].numpy().nonzero()
    height, width = street.detections.mask_left.shape[1:]
    m = WINDOW_MARGIN_PX
    return (
        max(int(columns.min()) - m, 0),
        max(int(rows.min()) - m, 0),
        min(int(columns.max()) + m, width),
        min(int(rows.max()) + m, height),
    )


def test_truth_has_no_residual() -> None:
    photometric, silhouette = maps()
    assert silhouette is not None
    seen = np.isfinite(photometric)
    assert seen.sum() > 200
    assert np.median(np.abs(photometric[seen])) < 2
    assert np.mean(np.abs(silhouette) > 1) < 0.05


def test_a_car_too_far_back_disagrees() -> None:
    at_truth, behind = maps()[0], maps((0, 0, 1.0))[0]
    assert np.nanmedian(np.abs(behind)) > 3 * np.nanmedian(np.abs(at_truth))


def test_signs_of_the_silhouette() -> None:
    found = maps((0.6, 0, 0))[1]
    assert found is not None
    columns = np.arange(found.shape[1])
    spilled, unfilled = (np.abs(found) * (found > 0)).sum(axis=0), (np.abs(found) * (found < 0)).sum(axis=0)
    # Moved to the right it leaves its mask's left side empty and spills out on the right.
    assert np.average(columns, weights=unfilled) + 5 < np.average(columns, weights=spilled)


def test_hidden_pixels_have_none() -> None:
    _, street = cached_street(torch.float32)
    hidden = np.ones(street.detections.mask_left.shape[1:], dtype=np.bool_)
    photometric, silhouette = maps((0.6, 0, 0), hidden=hidden)
    assert silhouette is not None
    assert not np.isfinite(photometric).any()
    assert not silhouette.any()


def test_brightness_is_matched_where_the_run_matched_it() -> None:
    prior, street = cached_street(torch.float32)
    darker = replace(street.frames, images_right=0.9 * street.frames.images_right)
    T, code = street.detections.T_cam_obj[0].double().numpy(), street.code[0].double().numpy()
    hidden = np.zeros(street.detections.mask_left.shape[1:], dtype=np.bool_)
    medians = []
    for words in ([], ["photometric.brightness=none"]):
        photometric, none = residual_maps(darker, prior, T, code, window(), None, hidden, load_config(None, words))
        assert none is None
        medians.append(abs(float(np.nanmedian(photometric))))
    assert medians[0] < 2
    assert medians[1] > 6


@pytest.mark.parametrize("points", [[[0.0, 0.0, -5.0]], [[-90.0, 0.0, 10.0], [-80.0, 1.0, 10.0]]])
def test_no_bounds_for_what_is_not_seen(points: list[list[float]]) -> None:
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    assert View(np.zeros((100, 100, 3), np.uint8), K).bounds(np.array(points)) is None


@example(3, 1239, 0, 9)  # a range of float steps ends on the border here
@given(st.integers(0, 1300), st.integers(1, 1300), st.integers(0, 400), st.integers(1, 400))
def test_a_grid_stays_in_its_window(u: int, width: int, v: int, height: int) -> None:
    grid = pixel_grid((u, v, u + width, v + height), min(width, 240)).reshape(-1, 2).long()
    assert grid.amin(dim=0).tolist() == [u, v]
    assert grid[:, 0].max() < u + width
    assert grid[:, 1].max() < v + height
