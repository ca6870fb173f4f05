"""The IoU of rotated boxes agrees with hand-derived numbers and OpenCV, and obeys its laws."""

import math

import cv2
import numpy as np
import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.evaluation.rotated_iou import bev_iou, iou_3d


def _boxes(*rows: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _random_boxes(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 5, generator=generator, dtype=torch.float64)
    low, high = _boxes((-3, 17, 0.3, 0.3, -4))[0], _boxes((3, 23, 5, 3, 4))[0]
    return low + unit * (high - low)


def _reference_intersection(a: torch.Tensor, b: torch.Tensor) -> float:
    """The intersection by OpenCV in float32; its angles count from x towards z, but a heading from x away from z."""
    rectangles = [
        ((x, z), (length, width), -math.degrees(yaw)) for x, z, length, width, yaw in (a.tolist(), b.tolist())
    ]
    _, points = cv2.rotatedRectangleIntersection(*rectangles)
    return 0.0 if points is None else float(cv2.contourArea(cv2.convexHull(points)))


HAND_DERIVED = [
    # (a, b, overlap)
    pytest.param((0, 10, 4, 2, 0), (0, 10, 4, 2, 0), 1.0, id="identical"),
    pytest.param((0, 10, 4, 2, 0.7), (0, 10, 4, 2, 0.7), 1.0, id="identical-turned"),
    pytest.param((0, 10, 4, 2, 0.7), (0, 10, 4, 2, 0.7 + math.pi), 1.0, id="identical-but-reversed"),
    pytest.param((0, 10, 4, 2, 0), (0, 10, 2, 4, math.pi / 2), 1.0, id="length-and-width-swapped"),
    # Shift by half the length: 2 x 2 shared, union 8 + 8 - 4.
    pytest.param((0, 10, 4, 2, 0), (2, 10, 4, 2, 0), 4 / 12, id="half-length"),
    pytest.param((0, 10, 4, 2, 0), (4, 10, 4, 2, 0), 0.0, id="touching-edges"),
    pytest.param((0, 10, 4, 2, 0), (4, 12, 4, 2, 0), 0.0, id="touching-corners"),
    pytest.param((0, 10, 4, 2, 0), (0, 30, 4, 2, 0.3), 0.0, id="apart"),
    # A unit square well inside, at any heading: 1 / 8.
    pytest.param((0.2, 10, 1, 1, 0.4), (0, 10, 4, 2, 0), 1 / 8, id="contained"),
    pytest.param((0, 10, 4, 2, 0), (0.2, 10, 1, 1, 0.4), 1 / 8, id="contains"),
    # Two unit squares at 45 degrees share a regular octagon of inradius 1/2: area 8 r^2 tan(22.5 deg).
    pytest.param(
        (0, 0, 1, 1, 0),
        (0, 0, 1, 1, math.pi / 4),
        (2 * math.tan(math.pi / 8)) / (2 - 2 * math.tan(math.pi / 8)),
        id="octagon",
    ),
    # A cross of 4 x 2 and 2 x 4: 4 shared of 12.
    pytest.param((0, 0, 4, 2, 0), (0, 0, 4, 2, math.pi / 2), 4 / 12, id="cross"),
    # Yaw sign: with rotation_y = +45 deg the length runs along (x, z) = (1, -1). The small square there is inside.
    pytest.param((0, 0, 4, 1, math.pi / 4), (1.2, -1.2, 0.2, 0.2, 0), 0.04 / 4, id="yaw-sign"),
    pytest.param((0, 0, 4, 1, math.pi / 4), (1.2, 1.2, 0.2, 0.2, 0), 0.0, id="yaw-sign-other-side"),
    pytest.param((0, 0, 0, 0, 0.3), (0, 0, 0, 0, 0.1), 0.0, id="two-points"),
    pytest.param((0, 0, 4, 0, 0.3), (0, 0, 4, 0, 0.3), 0.0, id="two-lines"),
    pytest.param((0, 0, 0, 2, 0.3), (0, 0, 4, 2, 0.1), 0.0, id="line-in-box"),
    pytest.param((0, 0, -4, 2, 0.0), (0, 0, 4, 2, 0.0), 0.0, id="negative-size-is-empty"),
]


@pytest.mark.parametrize(("a", "b", "overlap"), HAND_DERIVED)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_hand_derived(a: tuple[float, ...], b: tuple[float, ...], overlap: float, dtype: torch.dtype, tolerance: float):
    first, second = _boxes(a).to(dtype), _boxes(b).to(dtype)
    for pair in ((first, second), (second, first)):
        got = bev_iou(*pair)
        assert got.dtype == dtype
        assert got.item() == pytest.approx(overlap, abs=tolerance)


def test_equals_opencv_on_random_boxes():
    a, b = _random_boxes(400, seed=1), _random_boxes(400, seed=2)
    shared = np.array([_reference_intersection(p, q) for p, q in zip(a, b, strict=True)])
    areas = (a[:, 2] * a[:, 3]).numpy(), (b[:, 2] * b[:, 3]).numpy()
    assert (shared > 0).mean() > 0.3  # the comparison is not one of zeros
    np.testing.assert_allclose(bev_iou(a, b).numpy(), shared / (areas[0] + areas[1] - shared), atol=5e-4)


def test_iou_3d_hand_derived():
    # Footprints 4 x 2 shifted by 2 share 4; heights 1.5 (y 0.1 .. 1.6) and 2.0 (y -0.9 .. 1.1) share 1.0.
    a, b = _boxes((0, 1.6, 10, 1.5, 2, 4, 0)), _boxes((2, 1.1, 10, 2.0, 2, 4, 0))
    expected = 4.0 / (8 * 1.5 + 8 * 2.0 - 4.0)
    assert iou_3d(a, b).item() == pytest.approx(expected, abs=1e-12)
    assert iou_3d(a, a).item() == pytest.approx(1, abs=1e-12)
    above = _boxes((0, 0.1, 10, 1.5, 2, 4, 0))  # stands exactly on top of a
    assert iou_3d(a, above).item() == 0
    flat = _boxes((0, 1.6, 10, 0.0, 2, 4, 0))
    assert iou_3d(a, flat).item() == 0
    assert iou_3d(flat, flat).item() == 0


def test_wrong_shapes_are_named():
    with pytest.raises(InputError, match=r"boxes_a: expected shape \(N, 5\), got \(2, 7\)"):
        bev_iou(torch.zeros(2, 7), torch.zeros(2, 5))
    with pytest.raises(InputError, match=r"boxes_b: expected shape \(2, 5\), got \(3, 5\)"):
        bev_iou(torch.zeros(2, 5), torch.zeros(3, 5))
    with pytest.raises(InputError, match=r"boxes_b: expected shape \(1, 7\)"):
        iou_3d(torch.zeros(1, 7), torch.zeros(2, 7))
