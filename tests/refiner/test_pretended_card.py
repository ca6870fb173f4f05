"""Whole refinements run on a device whose tensors do not mix with the CPU's (`helpers.pretended_card`).

It takes the place of a graphics card and finds tensors left on the wrong device and waits of the host.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from torch.utils import backend_registration

pytestmark = pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this PyTorch has no devices that are written in Python",
)

_TESTS = Path(__file__).parents[1]
_COMPARED = [
    "default",
    "product form, marched rays",
    "point cloud",
    "implicit gradients",
    "neural prior, other residuals and priors, every step",
    "tracks, unrolled gradients",
]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The results of `helpers.card_cases`, computed once in a separate process, to which the device belongs."""
    file = tmp_path_factory.mktemp("card") / "found.json"
    paths = [str(_TESTS), str(_TESTS.parent), str(_TESTS.parent / "scripts"), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-m", "helpers.card_cases", str(file)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    cases: dict[str, Any] = json.loads(file.read_text())
    return cases


def _of(found: dict[str, Any], case: str) -> dict[str, Any]:
    assert "error" not in found[case], found[case]["error"]
    figures: dict[str, Any] = found[case]
    return figures


@pytest.mark.parametrize("case", _COMPARED)
def test_a_card_gives_the_results_of_the_processor_to_the_bit(found: dict[str, Any], case: str) -> None:
    differences = _of(found, case)
    assert len(differences) > 20
    assert {name for name, largest in differences.items() if largest != 0} == set()
    assert ("gradient" in differences) == case.endswith("gradients")


def test_iterations_let_the_host_wait_once_a_block_and_compactions_not_at_all(found: dict[str, Any]) -> None:
    waits = _of(found, "waits of blocks")
    # Cars end in different blocks, so there were compactions.
    assert len({-(-count // waits["length of a block"]) for count in waits["iterations"]}) > 1
    assert waits["by place"] == {"tolist in _read": waits["blocks"]}
    # Tracks have one stage more. Where views leave, the places of the others are sent; nothing more is read.
    assert set(_of(found, "waits of blocks of tracks")["by place"]) == {"tolist in _read", "aten.copy_ in from_numbers"}


def test_a_whole_call_lets_the_host_wait_some_forty_times(found: dict[str, Any]) -> None:
    """A guard: places and pixels that are counted, numbers that are sent, a decomposition that may fail."""
    by_place = _of(found, "waits of blocks")["in all"]
    assert 30 < sum(by_place.values()) <= 44, by_place
    # No operation is asked for its places by a mask: each such index is one wait more.
    assert not any(place.startswith("aten.index") for place in by_place)


def test_many_masks_let_the_host_wait_no_more_often_than_few(found: dict[str, Any]) -> None:
    waits = _of(found, "waits of masks")
    assert len(waits) == 5
    for few, many in waits.values():
        assert few == many <= 8


def test_the_demo_writes_the_same_files(found: dict[str, Any]) -> None:
    demo = _of(found, "demo")
    assert len(demo["names"]) > 5
    # These name the device, and what it took.
    assert demo["differ"] == ["timings.json"]


def test_the_page_for_a_card_has_results_gradients_and_times(found: dict[str, Any]) -> None:
    assert not isinstance(found["page"], dict), found["page"]["error"]
    rows = dict(line.strip("| ").split(" | ") for line in found["page"].splitlines() if line.startswith("| "))
    for name in ("given boxes", "masks alone"):
        assert rows[f"{name}: cars with the CPU's status"] == "6 of 6"
        assert rows[f"{name}: median distance from the CPU's place"] == "0 mm"
    assert rows["unrolled gradient by the right image: distance from the CPU's, over its size"] == "0"
    assert rows["1 frames, 6 cars, eager: time"].endswith("ms a car")


def test_tensors_of_both_devices_do_not_mix_and_waits_are_noted(found: dict[str, Any]) -> None:
    card = _of(found, "the card itself")
    assert card["problems"] == 4
    assert card["waits"] == [
        "aten._local_scalar_dense",
        "tolist",
        "aten.nonzero",
        "aten.index",
        "aten._to_copy",
        "aten.copy_",
        "aten.copy_",
        "aten._linalg_eigh",
    ]
