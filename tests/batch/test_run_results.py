"""Which frames of an output folder are finished, and how they can be named."""

from __future__ import annotations

from pathlib import Path

import pytest

from directshape_torch.batch.run_results import finished_frames
from directshape_torch.errors import InputError
from directshape_torch.io.run_manifest import RunManifest

OUT = Path("out")


def manifest(*done: str) -> RunManifest:
    frames = {name: {"state": "done"} for name in done}
    return RunManifest("1", {}, {}, frames={**frames, "000099": {"state": "failed", "reason": "no image"}})


def test_all_that_are_done_in_order() -> None:
    assert finished_frames(OUT, manifest("000107", "000007", "a_b")) == ["000007", "000107", "a_b"]
    assert finished_frames(OUT, manifest()) == []


@pytest.mark.parametrize("wanted", [["107"], [107], ["000107"], ["0107", 107]])
def test_numbers_name_frames_with_zeros_or_without(wanted: list[str | int]) -> None:
    assert finished_frames(OUT, manifest("000107", "000007"), wanted) == ["000107"]


def test_an_id_is_itself_before_it_is_a_number() -> None:
    run = manifest("07", "7")
    assert [finished_frames(OUT, run, [word]) for word in ("07", "7")] == [["07"], ["7"]]


def test_frames_that_are_not_finished_are_named() -> None:
    with pytest.raises(InputError, match=r"frames: expected finished frames of out, got 8, x, 99"):
        finished_frames(OUT, manifest("000007"), ["7", "8", "x", "99"])
