"""Figures of point sets agree with values by hand, and points of surfaces lie where they should."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic_scene import stereo_camera
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.evaluation.shape_error import TAUS_M, segment_truth, shape_error


def test_completeness_and_accuracy_are_told_apart() -> None:
    """True at 0, 1, 2, 10; estimated at 0.1, 2.2: of the true ones 0 (0.1 off) and, from 0.2 on, 2 (0.2 off) and, from
    0.9 on, 1 (0.9 off) are matched; of the estimated ones the first at 0.1, both at 0.2."""
    true = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [10, 0, 0]])
    estimated = np.array([[0.1, 0, 0], [2.2, 0, 0]])
    error = shape_error(true, estimated, taus_m=(0.15, 0.25, 0.95))
    assert error.completeness.tolist() == [0.25, 0.5, 0.75]
    assert error.accuracy.tolist() == [0.5, 1.0, 1.0]
    assert error.f1 == pytest.approx([2 * 0.125 / 0.75, 1 / 1.5, 1.5 / 1.75])
    # Only over matched true points: the one at 10 never counts.
    assert error.rmse_m == pytest.approx([0.1, np.sqrt((0.01 + 0.04) / 2), np.sqrt((0.01 + 0.04 + 0.81) / 3)])


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(0, 30))
def test_against_all_distances_and_its_laws(seed: int, num_true: int, num_estimated: int) -> None:
    rng = np.random.default_rng(seed)
    true, estimated = rng.normal(size=(num_true, 3)), rng.normal(size=(num_estimated, 3))
    error = shape_error(true, estimated)
    distance = np.linalg.norm(true[:, None] - estimated[None], axis=-1)
    for k, tau in enumerate(TAUS_M):
        nearest = distance.min(axis=1, initial=np.inf)
        matched = nearest[nearest <= tau]
        assert error.completeness[k] == pytest.approx(len(matched) / num_true)
        assert error.accuracy[k] == pytest.approx((distance.min(axis=0) <= tau).mean() if num_estimated else 0)
        assert (
            np.isnan(error.rmse_m[k])
            if not len(matched)
            else error.rmse_m[k] == pytest.approx(np.sqrt((matched**2).mean()))
        )
    assert (np.diff(error.completeness) >= 0).all()
    assert (np.nan_to_num(error.rmse_m) <= TAUS_M).all()


@pytest.mark.parametrize(
    ("true", "estimated", "taus", "text"),
    [
        (np.zeros((0, 3)), np.zeros((1, 3)), (0.1,), "true_points: expected at least one point, got none"),
        (np.zeros((2, 2)), np.zeros((1, 3)), (0.1,), r"true_points: expected shape \(N, 3\), got \(2, 2\)"),
        (np.zeros((2, 3)), np.full((1, 3), np.nan), (0.1,), "estimated_points: expected finite coordinates"),
        (np.zeros((2, 3)), np.zeros((1, 3)), (0.0, 0.1), "taus_m: expected distances above 0"),
    ],
)
def test_wrong_input(
    true: NDArray[np.float64], estimated: NDArray[np.float64], taus: tuple[float, ...], text: str
) -> None:
    with pytest.raises(InputError, match=text):
        shape_error(true, estimated, taus)


def test_points_of_a_segment_are_those_of_its_known_depths() -> None:
    camera = stereo_camera(20, 12, 150.0)
    depth = np.full((12, 20), np.nan)
    depth[3, 5], depth[4, 6], depth[9, 9] = 8.0, 10.0, 7.0
    inside = np.zeros((12, 20), dtype=bool)
    inside[:6] = True
    truth = segment_truth("mask", depth, inside, camera)
    assert truth.uv_left.tolist() == [[5, 3], [6, 4]]
    assert truth.points_cam[:, 2].tolist() == [8.0, 10.0]
    again = truth.points_cam @ camera.K_left[0].numpy().T
    np.testing.assert_allclose(again[:, :2] / again[:, 2:], truth.uv_left)
