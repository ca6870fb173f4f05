"""Completeness, accuracy, F1 and RMSE on sets of points whose figures are derived by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.evaluation.shape_error import TAUS_M, shape_error

LENGTH, HEIGHT, WIDTH = 4.0, 1.5, 1.6
AREA = 2 * (LENGTH * HEIGHT + LENGTH * WIDTH + HEIGHT * WIDTH)


def lattice() -> NDArray[np.float64]:
    """Nodes a metre apart: moved by less than half a metre each is nearest to its own image."""
    return np.stack(np.meshgrid(*[np.arange(5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def box_points(count: int, seed: int) -> NDArray[np.float64]:
    """Points uniform by area on a box of 4 x 1.5 x 1.6 m."""
    rng = np.random.default_rng(seed)
    size = np.array([LENGTH, HEIGHT, WIDTH])
    areas = np.array([HEIGHT * WIDTH, LENGTH * WIDTH, LENGTH * HEIGHT])
    axis = rng.choice(3, size=count, p=areas / areas.sum())
    points = (rng.random((count, 3)) - 0.5) * size
    rows = np.arange(count)
    points[rows, axis] = 0.5 * size[axis] * rng.choice([-1.0, 1.0], size=count)
    return points


def test_taus_are_those_of_the_issue() -> None:
    assert np.allclose(TAUS_M, np.arange(0.05, 1.001, 0.05))
    assert len(TAUS_M) == 20


def test_identity_is_perfect() -> None:
    error = shape_error(lattice(), lattice())
    assert (error.completeness == 1).all()
    assert (error.accuracy == 1).all()
    assert (error.f1 == 1).all()
    assert (error.rmse_m == 0).all()


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


def test_within_is_at_most() -> None:
    error = shape_error(np.zeros((1, 3)), np.array([[0.5, 0.0, 0.0]]), taus_m=(0.5,))
    assert error.completeness.tolist() == [1.0]
    assert error.accuracy.tolist() == [1.0]


def test_a_box_shifted_along_its_length() -> None:
    """By 0.2 m, tau 0.1 m. Of the true box the rear face is 0.2 m from the estimate, and the strip of 0.1 m of the four
    sides next to it is farther than 0.1 m from the estimated rear edge. Of the front face only a rim of 0.1 m is near
    the estimated sides. By symmetry the same holds for the estimate."""
    shifted = box_points(60_000, seed=1) + np.array([0.2, 0.0, 0.0])
    error = shape_error(box_points(60_000, seed=0), shifted, taus_m=(0.1, 0.25))
    rear = HEIGHT * WIDTH
    strip = 0.1 * 2 * (HEIGHT + WIDTH)
    front = (HEIGHT - 0.2) * (WIDTH - 0.2)
    expected = 1 - (rear + strip + front) / AREA
    assert error.completeness[0] == pytest.approx(expected, abs=0.01)
    assert error.accuracy[0] == pytest.approx(expected, abs=0.01)
    assert error.completeness[1] == error.accuracy[1] == 1.0


def test_a_shape_without_points_matches_nothing() -> None:
    error = shape_error(lattice(), np.zeros((0, 3)))
    assert error.num_estimated == 0
    for values in (error.completeness, error.accuracy, error.f1):
        assert (values == 0).all()
    assert np.isnan(error.rmse_m).all()


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(1, 30))
def test_against_all_distances_and_its_laws(seed: int, num_true: int, num_estimated: int) -> None:
    rng = np.random.default_rng(seed)
    true, estimated = rng.normal(size=(num_true, 3)), rng.normal(size=(num_estimated, 3))
    error = shape_error(true, estimated)
    distance = np.linalg.norm(true[:, None] - estimated[None], axis=-1)
    for k, tau in enumerate(TAUS_M):
        nearest = distance.min(axis=1)
        matched = nearest[nearest <= tau]
        assert error.completeness[k] == pytest.approx(len(matched) / num_true)
        assert error.accuracy[k] == pytest.approx((distance.min(axis=0) <= tau).mean())
        assert (
            np.isnan(error.rmse_m[k])
            if not len(matched)
            else error.rmse_m[k] == pytest.approx(np.sqrt((matched**2).mean()))
        )
    assert (np.diff(error.completeness) >= 0).all()
    assert (error.rmse_m[error.num_true_matched > 0] <= np.array(TAUS_M)[error.num_true_matched > 0]).all()
    swapped = shape_error(estimated, true)
    assert swapped.completeness.tolist() == error.accuracy.tolist()
    assert swapped.f1 == pytest.approx(error.f1)


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
