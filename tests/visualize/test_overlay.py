"""The picture of a frame shows the cars where they are, in every state."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from helpers.bundled_frame import BOXES, DEMO, MASKS
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import cached_street, disturbed, joined_frames

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, InputError, RefinementResult, load_config
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.status import Status
from directshape_torch.visualize.drawing import BLUE, GREEN, GREY, ORANGE, Array, Picture, View
from directshape_torch.visualize.drawn_car import DrawnCar, most_telling
from directshape_torch.visualize.overlay import draw_footprint, ground_view, overlay, overlay_of_frame, overlay_picture

P = np.array([[700.0, 0.0, 500.0, 0.0], [0.0, 700.0, 150.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
# Two triangles a face would do as well for pictures: the outline is that of the convex hull.
FACES = np.array([[i, j, k] for i in range(8) for j in range(i + 1, 8) for k in range(j + 1, 8)])


def corners(x: float, z: float) -> Array:
    pose = pose_from_kitti(torch.tensor([x, 1.6, z]), torch.tensor(0.3))
    found: Array = box_corners(pose, torch.tensor([1.5, 1.7, 4.0])).double().numpy()
    return found


def car(x: float, z: float, line: int = 1, status: str | None = "converged") -> DrawnCar:
    points = corners(x, z)
    return DrawnCar(np.eye(4), points, np.zeros(0), trimesh.Trimesh(points, FACES, process=False), line, status)


def has_colour(picture: Picture, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=-1) < 30).any())


def image(height: int = 300, width: int = 1000) -> View:
    return View(np.full((height, width, 3), 90, np.uint8), P)


def test_rows_show_before_and_after() -> None:
    picture = overlay_picture(image(), [car(0, 12, status=None)], [car(0.5, 13)], [corners(0.4, 13)])
    before, after, birds_eye = picture[30:300, :1000], picture[330:600, :1000], picture[:, 1000:]
    assert has_colour(before, ORANGE)
    assert not has_colour(before, BLUE)
    assert has_colour(after, BLUE)
    assert not has_colour(after, ORANGE)
    # Below the legend.
    for colour in (ORANGE, BLUE, GREEN):
        assert has_colour(birds_eye[100:], colour)


def test_cars_that_were_not_refined_are_grey() -> None:
    picture = overlay_picture(image(), [car(0, 12, status=None)], [car(0, 12, status="no_mask")])
    assert has_colour(picture[330:600, :1000], GREY)
    assert not has_colour(picture[330:600, :1000], BLUE)


@pytest.mark.parametrize("z", [-8.0, 0.5, 400.0])
def test_cars_in_odd_places_do_not_break_the_picture(z: float) -> None:
    picture = overlay_picture(image(), [car(0, z, status=None), car(0, 12, 2, None)], [car(0, z), car(0, 12, 2)])
    assert has_colour(picture[30:300, :1000], ORANGE)


def test_the_view_from_above_is_true_to_scale() -> None:
    square = np.array([[x, 0, z] for x, z in ((-2, 10), (2, 10), (2, 14), (-2, 14))], dtype=float)
    ground = ground_view(np.concatenate([np.zeros((1, 3)), square]), (800, 800))
    draw_footprint(ground, square, BLUE)
    rows, columns = np.nonzero(np.abs(ground.picture.astype(int) - BLUE).max(axis=-1) < 30)
    # From 3 m behind the camera to 3 m beyond the box: 20 m in 800 px.
    assert columns.max() - columns.min() == pytest.approx(4 * 40, abs=2)
    assert rows.max() - rows.min() == pytest.approx(4 * 40, abs=2)
    assert rows.max() == pytest.approx(799 - 13 * 40, abs=2)


def test_far_truth_is_left_out_of_the_scale() -> None:
    plain = overlay_picture(image(), [car(0, 12, status=None)], [car(0, 12)])
    with_far = overlay_picture(image(), [car(0, 12, status=None)], [car(0, 12)], [corners(0, 150)])
    # Below the legend nothing moves.
    np.testing.assert_array_equal(with_far[150:], plain[150:])


@cache
def call_of_two_frames() -> tuple[FrameBatch, Detections, RefinementResult]:
    """The street twice, its second car in the second frame; the first frame has no masks and is not refined."""
    prior, street = cached_street()
    d = disturbed(street.detections)
    seen = torch.tensor([False, True])
    masks = {"mask_left": d.mask_left.where(seen), "mask_right": d.mask_right.where(seen)}
    detections = replace(d, frame_index=torch.tensor([0, 1]), **masks)
    frames = joined_frames([street.frames, street.frames])
    result = DirectShapeRefiner(prior, load_config("fast"))(frames, detections)
    # Grey images would hide grey lines.
    return replace(frames, images_left=torch.zeros_like(frames.images_left)), detections, result


def test_tensors_of_a_call_are_drawn_where_their_cars_are() -> None:
    frames, detections, result = call_of_two_frames()
    height, width = frames.sizes[0].tolist()
    enlarged = 1000 / width
    rows = round(enlarged * height)
    for frame, colour, other in ((0, GREY, BLUE), (1, BLUE, GREY)):
        picture = overlay(frames, detections, result, frame)
        assert picture.dtype == np.uint8
        assert picture.shape[1:] == (1000 + 560, 3)
        # Below the title; 6 pixels are between the rows.
        before, after = picture[40:rows, :1000], picture[rows + 46 : 2 * rows + 6, :1000]
        assert has_colour(before, ORANGE)
        assert has_colour(after, colour)
        assert not has_colour(after, other)
        uv = View.of_frame(frames, number=frame).project(result.corners()[frame].numpy())
        v, u = np.nonzero(np.abs(after.astype(int) - colour).max(axis=-1) < 30)
        left, right = uv[:, 0].min() * enlarged, uv[:, 0].max() * enlarged
        assert left - 3 <= u.min() <= left + 5
        assert right - 5 <= u.max() <= right + 3
        assert v.max() + 40 <= uv[:, 1].max() * enlarged + 3


def test_tensors_and_files_give_the_same_picture() -> None:
    """But for the line numbers of the file, which are those of the rows here, and the truth from above."""
    loaded = open_dataset("kitti", DEMO, BOXES, MASKS).load("000000")
    numbers = dict(zip(loaded.row_of_detection, range(len(loaded.detections)), strict=True))
    objects = [replace(one, line_number=numbers.get(row, 99)) for row, one in enumerate(loaded.input_objects)]
    loaded = replace(loaded, input_objects=tuple(objects), labels=None)
    result = DirectShapeRefiner(config=load_config("fast"))(loaded.frame, loaded.detections)
    picture = overlay(loaded.frame, loaded.detections, result)
    assert (np.abs(picture.astype(int) - overlay_of_frame(loaded, result)).max(axis=-1) > 40).mean() < 2e-4


def test_a_frame_without_cars_and_a_box_that_is_not_finite() -> None:
    frames, detections, result = call_of_two_frames()
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[0] = torch.nan
    for given in (replace(detections, T_cam_obj=T_cam_obj), replace(detections, frame_index=torch.tensor([1, 1]))):
        assert not has_colour(overlay(frames, given, result)[40:240, :1000], ORANGE)


def test_what_does_not_belong_together_is_refused() -> None:
    frames, detections, result = call_of_two_frames()
    with pytest.raises(InputError, match="result: expected that of the 2 detections, got 1 cars"):
        overlay(frames, detections, result[:1])
    for frame in (2, -1, 0.5, "000000"):
        with pytest.raises(InputError, match=r"frame: expected a number of 0\.\.1"):
            overlay(frames, detections, result, frame)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="detections: expected a Detections, got RefinementResult"):
        overlay(frames, result, detections)  # type: ignore[arg-type]


def test_of_many_cars_the_refined_ones_are_drawn_and_then_the_nearest() -> None:
    """Detectors that write down whatever they have fill a frame with thousands of boxes."""
    _, scene = cached_street()
    result = DirectShapeRefiner(ellipsoid_prior(), load_config("fast"))(scene.frames, scene.detections)
    rows = torch.tensor([0, 1] * 50)
    many = result[rows]
    many.status_code[:] = Status.no_mask.code
    many.status_code[97] = result.status_code[1]
    chosen = most_telling(scene.detections.rows(rows), many, torch.arange(100)).tolist()
    assert len(chosen) == 60
    assert 97 in chosen
    assert set(range(0, 100, 2)) <= set(chosen)  # the nearer of the two cars
    assert most_telling(scene.detections, result, torch.arange(2)).tolist() == [0, 1]
