"""Residual maps on the ray-cast street: nothing at the truth, the right sign and place away from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.synthetic_scene import cached_street
from hypothesis import example, given
from hypothesis import strategies as st

from directshape_torch.report.drawn_cars import car_window
from directshape_torch.report.residual_maps import (
    MapSettings,
    ResidualMaps,
    ViewedPair,
    photometric_picture,
    pixel_grid,
    residual_maps,
    silhouette_picture,
)

SHARP = MapSettings(contour_width_px=0.25)
WINDOW_MARGIN_PX = 6


def maps(shift_m: tuple[float, float, float] = (0, 0, 0), car: int = 0, **changes: object) -> ResidualMaps:
    prior, street = cached_street(torch.float32)
    T = street.detections.T_cam_obj[car].double().numpy().copy()
    T[:3, 3] += shift_m
    given = {
        "foreground": street.detections.mask_left[car].float().numpy(),
        "hidden": np.zeros(street.detections.mask_left.shape[1:], dtype=np.bool_),
        "settings": SHARP,
        **changes,
    }
    pair = ViewedPair.of_frame(street.frames)
    code = street.code[car].double().numpy()
    return residual_maps(pair, prior, T, code, window(car), **given)  # type: ignore[arg-type]


def window(car: int = 0) -> tuple[int, int, int, int]:
    _, street = cached_street(torch.float32)
    rows, columns = street.detections.mask_left[car].numpy().nonzero()
    height, width = street.detections.mask_left.shape[1:]
    m = WINDOW_MARGIN_PX
    return (
        max(int(columns.min()) - m, 0),
        max(int(rows.min()) - m, 0),
        min(int(columns.max()) + m, width),
        min(int(rows.max()) + m, height),
    )


def test_truth_has_no_residual() -> None:
    found = maps()
    assert found.silhouette is not None
    seen = np.isfinite(found.photometric)
    assert seen.sum() > 200
    assert np.median(np.abs(found.photometric[seen])) < 2
    assert np.mean(np.abs(found.silhouette) > 1) < 0.05


def test_a_car_too_far_back_disagrees() -> None:
    at_truth, behind = maps().photometric, maps((0, 0, 1.0)).photometric
    assert np.nanmedian(np.abs(behind)) > 3 * np.nanmedian(np.abs(at_truth))


def test_signs_of_the_silhouette() -> None:
    found = maps((0.6, 0, 0)).silhouette
    assert found is not None
    columns = np.arange(found.shape[1])
    spilled, unfilled = (np.abs(found) * (found > 0)).sum(axis=0), (np.abs(found) * (found < 0)).sum(axis=0)
    # Moved to the right it leaves its mask's left side empty and spills out on the right.
    assert np.average(columns, weights=unfilled) + 5 < np.average(columns, weights=spilled)


def test_hidden_pixels_have_none() -> None:
    _, street = cached_street(torch.float32)
    hidden = np.ones(street.detections.mask_left.shape[1:], dtype=np.bool_)
    found = maps((0.6, 0, 0), hidden=hidden)
    assert found.silhouette is not None
    assert not np.isfinite(found.photometric).any()
    assert not found.silhouette.any()


def test_brightness_is_matched_where_the_run_matched_it() -> None:
    prior, street = cached_street(torch.float32)
    pair = ViewedPair.of_frame(replace(street.frames, images_right=0.9 * street.frames.images_right))
    T, code = street.detections.T_cam_obj[0].double().numpy(), street.code[0].double().numpy()
    hidden = np.zeros(street.detections.mask_left.shape[1:], dtype=np.bool_)
    medians = []
    for matches in (True, False):
        settings = MapSettings(matches_brightness=matches)
        found = residual_maps(pair, prior, T, code, window(), None, hidden, settings)
        assert found.silhouette is None
        medians.append(abs(float(np.nanmedian(found.photometric))))
    assert medians[0] < 2
    assert medians[1] > 6


def test_a_wide_window_is_thinned() -> None:
    assert pixel_grid((10, 5, 250, 25)).shape == (20, 240, 2)
    grid = pixel_grid((0, 0, 960, 100))
    assert grid.shape == (25, 240, 2)
    assert float(grid[..., 0].max()) < 960
    assert pixel_grid((3, 4, 6, 6))[0].tolist() == [[3, 4], [4, 4], [5, 4]]


def test_colours() -> None:
    image = np.full((4, 4, 3), 100, np.uint8)
    residual = np.array([[0.0, 80.0], [-80.0, np.nan]])
    picture = photometric_picture(image, (0, 0, 2, 2), residual)
    assert picture.tolist() == [[[245, 245, 245], [214, 47, 39]], [[49, 87, 200], [50, 50, 50]]]
    silhouette = silhouette_picture(image, (0, 0, 2, 2), np.array([[0.0, 4.6], [-4.6, 0.0]]))
    assert silhouette.tolist() == [[[50, 50, 50], [255, 140, 0]], [[186, 60, 220], [50, 50, 50]]]


@pytest.mark.parametrize(
    ("points", "expected"),
    [([[0.0, 0.0, -5.0]], None), ([[-90.0, 0.0, 10.0], [-80.0, 1.0, 10.0]], None)],
)
def test_no_window_for_what_is_not_seen(points: list[list[float]], expected: None) -> None:
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    assert car_window(np.zeros((100, 100, 3), np.uint8), K, np.array(points)) is expected


@example(3, 1239, 0, 9)  # a range of float steps ends on the border here
@given(st.integers(0, 1300), st.integers(1, 1300), st.integers(0, 400), st.integers(1, 400))
def test_a_grid_stays_in_its_window(u: int, width: int, v: int, height: int) -> None:
    grid = pixel_grid((u, v, u + width, v + height)).reshape(-1, 2).long()
    assert grid.amin(dim=0).tolist() == [u, v]
    assert grid[:, 0].max() < u + width
    assert grid[:, 1].max() < v + height
