"""Whole refinements run on a device whose tensors do not mix with the CPU's (`helpers.pretended_card`).

It takes the place of a graphics card and finds tensors left on the wrong device and waits of the host.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from torch.utils import backend_registration

pytestmark = pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this PyTorch has no devices that are written in Python",
)

_TESTS = Path(__file__).parents[1]
_COMPARED = ["default", "tracks, unrolled gradients"]
_ALSO_COMPARED = [
    "product form, marched rays",
    "point cloud",
    "implicit gradients",
    "neural prior, other residuals and priors, every step",
]
_WAITS = ["waits of blocks", "waits of masks", "the card itself"]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return _found(tmp_path_factory, [*_COMPARED, *_WAITS])


@pytest.fixture(scope="module")
def also_found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return _found(tmp_path_factory, [*_ALSO_COMPARED, "waits of blocks of tracks", "run", "page"])


def _found(tmp_path_factory: pytest.TempPathFactory, cases: list[str]) -> dict[str, Any]:
    """The results of `helpers.card_cases`, computed once in a separate process, to which the device belongs."""
    file = tmp_path_factory.mktemp("card") / "found.json"
    paths = [str(_TESTS), str(_TESTS.parent), str(_TESTS.parent / "scripts"), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-m", "helpers.card_cases", str(file), *cases],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    figures: dict[str, Any] = json.loads(file.read_text())
    return figures


def _of(found: dict[str, Any], case: str) -> dict[str, Any]:
    assert "error" not in found[case], found[case]["error"]
    figures: dict[str, Any] = found[case]
    return figures


@pytest.mark.parametrize("case", _COMPARED)
def test_a_card_gives_the_results_of_the_processor_to_the_bit(found: dict[str, Any], case: str) -> None:
    _check_same(found, case)


@pytest.mark.long
@pytest.mark.parametrize("case", _ALSO_COMPARED)
def test_a_card_gives_these_results_to_the_bit_too(also_found: dict[str, Any], case: str) -> None:
    _check_same(also_found, case)


def _check_same(found: dict[str, Any], case: str) -> None:
    differences = _of(found, case)
    assert len(differences) > 20
    assert {name for name, largest in differences.items() if largest != 0} == set()
    assert ("gradient" in differences) == case.endswith("gradients")


def test_the_host_waits_once_a_block(found: dict[str, Any]) -> None:
    waits = _of(found, "waits of blocks")
    assert Counter(waits["two blocks"]) - Counter(waits["one block"]) == {"aten._local_scalar_dense": waits["stages"]}


@pytest.mark.long
def test_the_host_waits_for_tracks_as_it_does_for_cars(also_found: dict[str, Any]) -> None:
    waits = _of(also_found, "waits of blocks of tracks")
    # Tracks go through the stages more than once, each car by itself among them.
    assert set(Counter(waits["two blocks"]) - Counter(waits["one block"])) == {"aten._local_scalar_dense"}


def test_cars_that_end_early_let_the_host_wait_no_more(found: dict[str, Any]) -> None:
    waits = _of(found, "waits of blocks")
    assert len(set(waits["blocks of cars"])) > 1
    assert not Counter(waits["cars end"]) - Counter(waits["two blocks"])


def test_a_whole_call_lets_the_host_wait_some_forty_times(found: dict[str, Any]) -> None:
    """A guard: places and pixels that are counted, numbers that are sent, a decomposition that may fail."""
    waits = _of(found, "waits of blocks")["cars end"]
    assert 30 < sum(waits.values()) <= 44, waits
    # No operation is asked for its places by a mask: each such index is one wait more.
    assert not any(operation.startswith("aten.index") for operation in waits)


def test_many_masks_let_the_host_wait_no_more_often_than_few(found: dict[str, Any]) -> None:
    waits = _of(found, "waits of masks")
    assert len(waits) == 5
    for few, many in waits.values():
        assert few == many <= 8


@pytest.mark.long
def test_a_run_writes_the_same_files(also_found: dict[str, Any]) -> None:
    run = _of(also_found, "run")
    assert len(run["names"]) > 5
    # These name the device, and what it took.
    assert run["differ"] == ["timings.json"]


@pytest.mark.long
def test_the_page_for_a_card_has_results_gradients_and_times(also_found: dict[str, Any]) -> None:
    assert not isinstance(also_found["page"], dict), also_found["page"]["error"]
    rows = dict(line.strip("| ").split(" | ") for line in also_found["page"].splitlines() if line.startswith("| "))
    for name in ("given boxes", "masks alone"):
        assert rows[f"{name}: cars with the CPU's status"] == "1 of 1"
        assert rows[f"{name}: median distance from the CPU's place"] == "0 mm"
    assert rows["unrolled gradient by the right image: distance from the CPU's, over its size"] == "0"
    assert rows["1 frames, 1 cars, eager: time"].endswith("ms a car")


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
