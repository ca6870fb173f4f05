"""Whatever stands in the place of a tensor is refused by name, or refined into finite numbers."""

from __future__ import annotations

import os
import random
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.synthetic_scene import cached_street
from hostile_tensors import MUTATIONS, at, changed, places

from directshape_torch import DirectShapeRefiner, load_config
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.scene import Detections, FrameBatch, Occluders
from directshape_torch.terms.lidar import LidarPoints

# Making odd tensors, PyTorch says that they are young, or old.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torch", "ignore:.*(prototype|beta|deprecated):UserWarning")

# Of these no tensor of a call takes any, whatever it holds.
NEVER = ("list", "array", "text", "number", "object", "float8", "complex", "unsigned", "quantised", "sparse", "blocked")
NEVER += ("compressed", "nested", "no memory", "half", "brain", "bytes", "short", "one more axis", "no axes", "more")
MASKS = ("mask_left", "mask_right")


@pytest.fixture(scope="module")
def call() -> tuple[FrameBatch, Detections]:
    """One with every tensor that a call can have."""
    _, street = cached_street()
    masks = torch.zeros_like(street.detections.mask_left[:1])
    one = masks.new_ones(1)
    frames = replace(
        street.frames,
        disparity=torch.full_like(street.frames.images_left[:, 0], 8.0),
        points_cam=street.frames.images_left.new_ones(1, 50, 3),
    )
    occluders = Occluders(torch.zeros(1, dtype=torch.long), masks, masks, 30 * one, 50 * one)
    return frames, replace(street.detections, occluders=occluders, pose_sigma=masks.new_full((2, 4), 0.5))


@pytest.fixture(scope="module")
def refiner() -> DirectShapeRefiner:
    config = load_config(
        None, ["stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 1}]", "method=combined"]
    )
    return DirectShapeRefiner(cached_street()[0], config, [LidarPoints()])


PLACES = [("frames", *path) for path in places(cached_street()[1].frames)]
PLACES += [("frames", "disparity"), ("frames", "points_cam")]
PLACES += [("detections", *path) for path in places(cached_street()[1].detections)]
PLACES += [("detections", "pose_sigma")]
PLACES += [("detections", "occluders", name) for name in ("frame_index", *MASKS, "depth_m", "bottom_v")]


def refined(refiner: DirectShapeRefiner, call: tuple[Any, Any], place: tuple[str, ...], value: object) -> object:
    which = ("frames", "detections").index(place[0])
    parts = list(call)
    parts[which] = changed(parts[which], place[1:], value)
    result = refiner(*parts)
    used = result.refined
    return torch.isfinite(result.T_cam_obj[used]).all() & torch.isfinite(result.code[used]).all()


@pytest.mark.parametrize("place", PLACES, ids=".".join)
def test_other_things_than_dense_tensors_of_the_right_type_are_named(
    refiner: DirectShapeRefiner, call: tuple[FrameBatch, Detections], place: tuple[str, ...]
) -> None:
    good = at(call[("frames", "detections").index(place[0])], place[1:])
    for name in NEVER:
        if name in ("half", "brain") and place[-1] in MASKS:
            continue  # probabilities may have fewer digits
        try:
            value = MUTATIONS[name](good, random.Random(0))
        except RuntimeError:  # PyTorch itself has none such
            continue
        # The first tensor of a record says what the others should be, so that one of them may be named in its place.
        with pytest.raises(InputError, match=r"^[\w.]+: expected .*, got ") as caught:
            refined(refiner, call, place, value)
        assert len(str(caught.value)) < 500


@pytest.mark.parametrize("place", ["frames.camera", "frames.ground", "detections.occluders"])
def test_a_part_of_other_precision_is_named(
    refiner: DirectShapeRefiner, call: tuple[FrameBatch, Detections], place: str
) -> None:
    record, name = place.split(".")
    parts = dict(zip(("frames", "detections"), call, strict=True))
    parts[record] = replace(parts[record], **{name: getattr(parts[record], name).to(dtype=torch.float32)})
    with pytest.raises(InputError, match=rf"^{place}\.\w+: expected dtype torch.float64 on cpu.*, got torch.float32"):
        refiner(parts["frames"], parts["detections"])


def test_odd_values_are_refused_or_refined(refiner: DirectShapeRefiner, call: tuple[FrameBatch, Detections]) -> None:
    chance = random.Random(7)
    others = [name for name in MUTATIONS if name not in NEVER]
    tries, accepted = int(os.environ.get("DIRECTSHAPE_FUZZ", "60")), 0
    for _ in range(tries):
        place, mutation = chance.choice(PLACES), MUTATIONS[chance.choice(others)]
        value = mutation(at(call[("frames", "detections").index(place[0])], place[1:]), chance)
        try:
            assert refined(refiner, call, place, value), (place, value)
            accepted += 1
        except DirectShapeError:
            pass
    assert tries / 6 < accepted < 5 * tries / 6


@pytest.mark.parametrize("name", [name for name in NEVER if name not in ("half", "brain", "bytes", "short")])
def test_weights_of_terms(refiner: DirectShapeRefiner, call: tuple[FrameBatch, Detections], name: str) -> None:
    value = MUTATIONS[name](torch.ones(2), random.Random(0))
    with pytest.raises(InputError, match=r"term_weights\['silhouette_left'\]: expected .*, got "):
        refiner(*call, {"silhouette_left": value})
