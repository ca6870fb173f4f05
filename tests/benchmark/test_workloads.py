"""Calls of any number of cars and any frame size."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from directshape_torch.benchmark.workloads import demo_scene, enlarged, first_cars, load_scenes, with_cars
from directshape_torch.errors import InputError
from directshape_torch.refiner import DirectShapeRefiner


@pytest.mark.parametrize(("count", "frames"), [(1, 1), (6, 1), (7, 2), (20, 4)])
def test_exactly_so_many_cars_in_as_few_frames_as_hold_them(count: int, frames: int) -> None:
    batch, detections = with_cars(demo_scene().frames, count)

    assert (len(detections), len(batch)) == (count, frames)
    assert torch.equal(detections.frame_index, torch.arange(count) // 6)


def test_cars_of_a_frame_without_any_cannot_be_repeated() -> None:
    empty = first_cars(demo_scene().frames[0], 0)

    with pytest.raises(InputError, match="at least one car"):
        with_cars([empty], 3)


def test_a_larger_frame_holds_the_same_cars() -> None:
    loaded = demo_scene().frames[0]
    larger = enlarged(loaded, 3)
    height, width = loaded.frame.images_left.shape[-2:]

    assert larger.frame.images_left.shape[-2:] == (3 * height, width)
    assert torch.equal(larger.frame.images_left[..., :height, :], loaded.frame.images_left)
    assert torch.equal(larger.detections.mask_left[:, :height], loaded.detections.mask_left)
    assert not larger.detections.mask_left[:, height:].any()


def test_a_larger_frame_shows_the_same_pixels_of_the_cars() -> None:
    loaded = demo_scene().frames[0]
    refiner = DirectShapeRefiner()

    before, _ = refiner.problem(loaded.frame, loaded.detections)
    larger = enlarged(loaded, 2)
    after, _ = refiner.problem(larger.frame, larger.detections)

    # A region that ended at the lower border now goes on below it.
    inside = after.left.uv[:, 1] < loaded.frame.images_left.shape[-2]
    assert inside.float().mean() > 0.9
    assert abs(len(after.left) - len(before.left)) < 0.1 * len(before.left)


def test_without_data_there_is_the_bundled_frame() -> None:
    (scene,) = load_scenes(None)

    assert (scene.name, len(scene.frames), scene.num_cars) == ("demo", 1, 6)


def test_a_folder_without_the_data_sets_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rendered or kitti"):
        load_scenes(tmp_path)
