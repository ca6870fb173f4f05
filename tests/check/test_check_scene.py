"""Mistakes in the tensors of a call are named, and correct calls give no finding; docs/check_data.md has the table."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from helpers.bundled_frame import BOXES, DEMO, MASKS
from helpers.matched_once import matched_once
from scene_mistakes import MISTAKES, Scene, answer, named, scene

from directshape_torch import DirectShapeRefiner, check_scene, load_config
from directshape_torch.errors import SceneWarning

DATA = os.environ.get("DIRECTSHAPE_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="DIRECTSHAPE_DATA is not set")
# One frame of six cars: what is seen in the image is seen here, headings of cars all along the street are not.
OF_ONE_FRAME = sorted(
    set(MISTAKES)
    - {"heading of the other sign", "heading in degrees", "heading off by 180 degrees", "heading of a LiDAR"}
    - {"right images of another frame"}
)


@lru_cache(maxsize=1)
def demo() -> Scene:
    return scene(DEMO, BOXES, MASKS)


@lru_cache(maxsize=1)
def eight_frames(data: str, detections: str) -> Scene:
    root = Path(str(DATA)) / data
    return scene(root, root / "detections" / detections, root / "training" / "masks", 8)


@pytest.fixture(scope="module", autouse=True)
def match_once() -> Iterator[None]:
    with matched_once():
        yield


def test_the_bundled_frame_is_correct() -> None:
    report = check_scene(*demo())
    assert report.findings == ()
    assert str(report) == "0 errors, 0 warnings, 0 notes in 1 frames with 6 cars"


@pytest.mark.parametrize("name", OF_ONE_FRAME)
def test_a_mistake_in_one_frame_is_named(name: str) -> None:
    report = answer(MISTAKES[name], demo())
    assert named(MISTAKES[name], report), report


MORE = (
    *(("kitti15", name, "training/masks") for name in ("noisy_stereo", "noisy_mono", "biased_mono")),
    *(("kitti", name, "training/masks") for name in ("noisy_stereo", "noisy_mono")),
    ("rendered", "stereo", "training/masks"),
)


@needs_data
@pytest.mark.parametrize(
    ("data", "detections", "masks"),
    [
        ("kitti15", "pointrcnn", "training/masks"),
        ("rendered", "mono", "masks_degraded"),
        *(pytest.param(*one, marks=pytest.mark.long) for one in MORE),
    ],
)
def test_correct_frames_raise_no_alarm(data: str, detections: str, masks: str) -> None:
    root = Path(str(DATA)) / data
    for count, first in ((1, 0), (1, 12), (6, 6)):
        found = check_scene(*scene(root, root / "detections" / detections, root / masks, count, first), False)
        # PointRCNN's boxes of two frames have no masks, which is said rightly.
        alarms = {finding.check for finding in found.findings if finding.severity != "note"} - {"no_masks"}
        assert alarms == set()


@needs_data
@pytest.mark.parametrize(
    ("data", "detections"), [("kitti15", "noisy_stereo"), pytest.param("rendered", "stereo", marks=pytest.mark.long)]
)
@pytest.mark.parametrize(
    "name", ["heading in degrees", "heading off by 180 degrees", "focal length 0.8 times too short"]
)
def test_mistakes_that_take_several_frames(name: str, data: str, detections: str) -> None:
    report = answer(MISTAKES[name], eight_frames(data, detections))
    assert named(MISTAKES[name], report), report


def test_the_refiner_warns_as_often_as_it_is_told() -> None:
    wrong = MISTAKES["centre of the box for its bottom"].make(*demo())
    for when, times in (("first", 1), ("always", 2), ("off", 0)):
        refiner = DirectShapeRefiner(config=load_config("fast", [f"check={when}"]))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(2):
                refiner(*wrong)
        said = [str(one.message) for one in caught if one.category is SceneWarning]
        assert len(said) == times
        assert all(text.startswith("error: box_origin (all frames, 6 cars): they fit when read as") for text in said)


def test_results_do_not_depend_on_the_check() -> None:
    frames, detections = demo()
    a, b = (
        DirectShapeRefiner(config=load_config("fast", [f"check={when}"]))(frames, detections)
        for when in ("always", "off")
    )
    assert a.T_cam_obj.equal(b.T_cam_obj)


def test_hopeless_tensors_are_checked_without_errors() -> None:
    frames, detections = demo()
    black = replace(frames, images_left=torch.full_like(frames.images_left, torch.nan), images_right=frames.images_left)
    T = detections.T_cam_obj.clone()
    T[0], T[1, 2, 3], T[2, 2, 3], T[3, :3, 3] = torch.nan, -5.0, 0.0, 1e30
    hopeless = replace(detections, T_cam_obj=T, box_2d=torch.full_like(detections.box_2d, torch.nan))
    for images, cars in ((black, hopeless), (frames, hopeless)):
        assert check_scene(images, cars).num_cars == 6
    assert check_scene(frames, detections.rows(torch.zeros(0, dtype=torch.int64)), match_images=False).findings == ()
