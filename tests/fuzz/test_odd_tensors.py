"""Any value in place of an argument is refused by name, or gives finite numbers."""

from __future__ import annotations

import random
from contextlib import suppress
from dataclasses import replace

import pytest
import torch
from helpers.synthetic_scene import cached_street
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from public_calls import OddCall, at, calls, odd_call, odd_numbers, whole_call
from tensor_values import MUTATIONS

from directshape_torch import Detections, DirectShapeRefiner
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.scene.frames import FrameBatch

# Making odd tensors, PyTorch says that they are young, or old.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torch", "ignore:.*(prototype|beta|deprecated):UserWarning")

# Of these no tensor of a call takes any, whatever it holds.
NEVER = ("list", "array", "text", "number", "object", "float8", "complex", "unsigned", "quantised", "sparse", "blocked")
NEVER += ("compressed", "nested", "no memory", "half", "brain", "bytes", "short", "one more axis", "no axes", "more")
MASKS = ("mask_left", "mask_right")
REFINE = calls()["refine"]


@pytest.mark.parametrize("place", [place for place in REFINE.places() if len(place) > 1], ids=".".join)
def test_other_things_than_dense_tensors_of_the_right_type_are_named(place: tuple[str, ...]) -> None:
    good = at(REFINE.arguments[place[0]], place[1:])
    for name in NEVER:
        if name in ("half", "brain") and place[-2:-1] and place[-2] in MASKS:
            continue  # probabilities may have fewer digits
        try:
            value = MUTATIONS[name](good, random.Random(0))
        except RuntimeError:  # PyTorch itself has none such
            continue
        # The first tensor of a record says what the others should be, so that one of them may be named in its place.
        with pytest.raises(InputError, match=r"^[\w.]+: expected .*, got ") as caught:
            OddCall(name, REFINE, place, value, False).outcome()
        assert len(str(caught.value)) < 500


@pytest.mark.parametrize("name", [name for name in NEVER if name not in ("half", "brain", "bytes", "short")])
def test_weights_of_terms(name: str) -> None:
    value = MUTATIONS[name](torch.ones(2), random.Random(0))
    with pytest.raises(InputError, match=r"term_weights\['silhouette_left'\]: expected .*, got "):
        REFINE.run({**REFINE.arguments, "weight": value})


@pytest.mark.parametrize("place", ["frames.camera", "frames.ground"])
def test_a_part_of_other_precision_is_named(place: str) -> None:
    record, name = place.split(".")
    frames, detections = whole_call()
    parts: dict[str, FrameBatch | Detections] = {"frames": frames, "detections": detections}
    parts[record] = replace(parts[record], **{name: getattr(parts[record], name).to(dtype=torch.float32)})
    with pytest.raises(InputError, match=rf"^{place}\.\w+: expected dtype torch.float64 on cpu.*, got torch.float32"):
        DirectShapeRefiner(cached_street()[0])(parts["frames"], parts["detections"])


@pytest.mark.parametrize("name", list(calls()))
def test_each_odd_value_for_what_is_no_tensor(name: str) -> None:
    for odd in odd_numbers(name):
        with suppress(DirectShapeError):
            assert odd.outcome(), f"{odd.name}: silently not finite"


# More of them, and what they cost: scripts/fuzz.py.
@pytest.mark.parametrize("tries", [4, pytest.param(100, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", list(calls()))
def test_odd_values_are_refused_or_taken(name: str, tries: int) -> None:
    @given(chance=st.randoms(use_true_random=False))
    @settings(max_examples=tries, suppress_health_check=list(HealthCheck))
    def call(chance: random.Random) -> None:
        odd = odd_call(chance, name)
        with suppress(DirectShapeError):
            assert odd.outcome(), f"{odd.name}: silently not finite"

    call()
