"""These tests check where the points of each car are, which pass the filters, and how many are kept."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.synthetic_scene import CAMERA_HEIGHT_M, masked, measured_street

from directshape_torch.config import PointCloudConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.rows import PointSamples
from directshape_torch.terms import car_points as points_of_cars
from directshape_torch.terms.car_points import car_points

ALL = PointCloudConfig(min_points=1, max_points=100_000)


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that leave out no point of the street, except where a test sets others."""
    monkeypatch.setattr(points_of_cars, "_HEIGHTS_M", (-99.0, 99.0))
    monkeypatch.setattr(points_of_cars, "_REACH_M", 1e3)


def points_of(config: PointCloudConfig = ALL, **changes: object) -> PointSamples:
    scene = measured_street()[1]
    frames = {name: value for name, value in changes.items() if name == "disparity"}
    others = {name: value for name, value in changes.items() if name not in ("disparity", "present")}
    detections = masked(scene.detections, changes.get("present"))  # type: ignore[arg-type]
    return car_points(replace(scene.frames, **frames), replace(detections, **others), config)  # type: ignore[arg-type]


def test_every_masked_pixel_gives_a_point_on_the_surface() -> None:
    prior, scene = measured_street()
    points = points_of()
    assert torch.equal(points.counts, (scene.detections.mask_left.dense() > 0.5).flatten(1).sum(1))
    assert torch.equal(torch.bincount(points.object_index), points.counts)
    T = se3.inverse(scene.detections.T_cam_obj)[points.object_index]
    sdf = prior.bind(scene.code).value(se3.transform(T, points.points_cam), points.object_index)
    assert sdf.abs().max() < 1e-6


def test_heights_are_above_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    everything = CAMERA_HEIGHT_M - points_of().points_cam[:, 1]
    monkeypatch.setattr(points_of_cars, "_HEIGHTS_M", (0.5, 1.0))
    points = points_of()
    height = CAMERA_HEIGHT_M - points.points_cam[:, 1]
    assert 0.5 <= height.min() < 0.55
    assert 0.95 < height.max() <= 1.0
    assert len(points.points_cam) == int(((everything >= 0.5) & (everything <= 1.0)).sum())


def test_distances_are_along_the_ground_from_the_centre_of_the_detection(monkeypatch: pytest.MonkeyPatch) -> None:
    everything = points_of()
    monkeypatch.setattr(points_of_cars, "_REACH_M", 1.6)
    detections = measured_street()[1].detections
    lifted = detections.T_cam_obj.clone()
    lifted[:, 1, 3] -= 7.0
    points = points_of(T_cam_obj=lifted)
    offset = (points.points_cam - detections.T_cam_obj[points.object_index, :3, 3])[:, [0, 2]].norm(dim=-1)
    assert 1.5 < offset.max() <= 1.6
    assert 0 < len(points.points_cam) < len(everything.points_cam)


NO_MASK = torch.tensor([False, False])


def test_without_a_mask_the_box_counts() -> None:
    detections = measured_street()[1].detections
    box = points_of(present=NO_MASK)
    # Where the map knows nothing there is no point, so the first car's box holds its own pixels and some of the other.
    assert (box.counts >= points_of().counts).all()
    absent = torch.tensor([True, False])
    mixed = points_of(present=absent)
    assert torch.equal(mixed.counts, torch.where(absent, points_of().counts, box.counts))
    narrow = detections.box_2d.clone()
    narrow[:, 2] = narrow[:, 0] + 4
    assert (points_of(present=NO_MASK, box_2d=narrow).counts < box.counts).all()


@pytest.mark.parametrize("unknown", [torch.nan, 0.0, -1.0, torch.inf])
def test_pixels_without_a_disparity_give_no_point(unknown: float) -> None:
    scene = measured_street()[1]
    assert scene.frames.disparity is not None
    spoiled = scene.frames.disparity.clone()
    spoiled[:, :, ::2] = unknown
    points = points_of(disparity=spoiled)
    assert points.points_cam.isfinite().all()
    assert torch.equal(points.counts, (scene.detections.mask_left.dense()[:, :, 1::2] > 0.5).flatten(1).sum(1))


def test_boxes_and_masks_beyond_a_smaller_frame_hold_no_points() -> None:
    scene = measured_street()[1]
    assert scene.frames.disparity is not None
    filled = scene.frames.disparity.nan_to_num(nan=7.0)
    frames = replace(scene.frames, disparity=filled, sizes=torch.tensor([[80, 70]]))
    box_2d = torch.tensor([[0.0, 0.0, 159.0, 119.0]]).double().expand(2, 4)
    everywhere = replace(masked(scene.detections, NO_MASK), box_2d=box_2d)
    assert car_points(frames, everywhere, ALL).counts.tolist() == [80 * 70] * 2
    inside = scene.detections.mask_left.dense()[:, :80, :70] > 0.5
    assert car_points(frames, scene.detections, ALL).counts.tolist() == inside.sum(dim=(1, 2)).tolist()


@pytest.mark.parametrize(
    ("box_2d", "count"),
    [
        ((10.2, 5.5, 14.9, 8.0), 4 * 3),
        ((10.0, 5.0, 14.0, 5.0), 5),
        ((-3.0, -3.0, 0.5, 0.5), 1),
        ((float("nan"), 5.0, 14.0, 8.0), 0),
    ],
)
def test_pixels_whose_middle_is_in_the_box_are_those_of_a_car_without_a_mask(
    box_2d: tuple[float, float, float, float], count: int
) -> None:
    scene = measured_street()[1]
    assert scene.frames.disparity is not None
    points = points_of(
        present=NO_MASK,
        disparity=torch.full_like(scene.frames.disparity, 7.0),
        box_2d=torch.tensor(box_2d).double().expand(2, 4),
    )
    assert points.counts.tolist() == [count] * 2


def test_in_parts_the_points_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many boxes without masks are read in parts, for memory."""
    whole = points_of(present=NO_MASK), points_of()
    monkeypatch.setattr(points_of_cars, "_MOST_PIXELS", 10)
    for expected, found in zip(whole, (points_of(present=NO_MASK), points_of()), strict=True):
        assert found.points_cam.equal(expected.points_cam)
        assert found.counts.equal(expected.counts)


def test_of_too_many_every_nth_is_kept() -> None:
    everything, some = points_of(), points_of(replace(ALL, max_points=100))
    assert torch.equal(some.counts, everything.counts)
    kept = torch.bincount(some.object_index)
    assert (kept <= 100).all()
    assert (kept > 50).all()
    first = everything.points_cam[everything.object_index == 0]
    stride = -(-len(first) // 100)
    torch.testing.assert_close(some.points_cam[some.object_index == 0], first[::stride])


def test_the_rigs_bias_is_taken_off() -> None:
    scene = measured_street()[1]
    camera, (height, width) = scene.frames.camera, scene.frames.images_left.shape[2:]
    field = DisparityField.constant(-0.7, (width, height), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])
    assert scene.frames.disparity is not None
    frames = replace(
        scene.frames,
        disparity=scene.frames.disparity - 0.7,
        camera=replace(camera, disparity_field=field.to(dtype=torch.float64)),
    )
    torch.testing.assert_close(car_points(frames, scene.detections, ALL).points_cam, points_of().points_cam)


def test_a_car_without_a_pose_has_no_points_and_touches_no_other() -> None:
    T_cam_obj = measured_street()[1].detections.T_cam_obj.clone()
    T_cam_obj[0] = torch.nan
    points, healthy = points_of(T_cam_obj=T_cam_obj), points_of()
    assert points.counts.tolist() == [0, int(healthy.counts[1])]
    assert torch.equal(points.points_cam, healthy.points_cam[healthy.object_index == 1])


def test_frames_without_disparity_are_an_error() -> None:
    with pytest.raises(InputError, match=r"frames\.disparity: expected a disparity map of each frame, got None"):
        points_of(disparity=None)
