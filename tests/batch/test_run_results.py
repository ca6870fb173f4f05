"""What summary and journals of a folder say together, which frames are finished, and how they can be named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from directshape_torch.batch.journal import FrameRecord, Journal, journal_folder
from directshape_torch.batch.run_results import finished_frames, read_run_results, summary_path
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.run_manifest import RunManifest, write_manifest

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


def entry(mesh_format: str) -> dict[str, Any]:
    name = f"meshes/000000_1.{mesh_format}"
    return {"state": "done", "outputs": [f"meshes_{mesh_format}"], "mesh_files": [name], "files": {name: "hash"}}


def test_journals_add_to_the_summary(tmp_path: Path) -> None:
    write_manifest(summary_path(tmp_path), RunManifest("0.1.0", {}, {}, {"000000": {}}, {"000000": entry("ply")}))
    journal = Journal(tmp_path, "r1")
    journal.add(FrameRecord("000000", {"image_left": "a"}, entry("glb")))
    journal.add(FrameRecord("000001", {}, {"state": "failed", "reason": "cut short"}))
    results = read_run_results(tmp_path)
    assert results.frames["000000"]["outputs"] == ["meshes_glb", "meshes_ply"]
    assert sorted(results.frames["000000"]["files"]) == ["meshes/000000_1.glb", "meshes/000000_1.ply"]
    assert results.inputs["000000"] == {"image_left": "a"}
    assert results.frames["000001"] == {"state": "failed", "reason": "cut short"}


def test_a_journal_that_goes_while_it_is_read_is_none(tmp_path: Path) -> None:
    write_manifest(summary_path(tmp_path), RunManifest("0.1.0", {}, {}))
    journal_folder(tmp_path).mkdir()
    (journal_folder(tmp_path) / "gone.jsonl").symlink_to(tmp_path / "nothing")
    assert read_run_results(tmp_path).frames == {}


def test_a_folder_without_a_summary(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match=r"summary\.json: is missing"):
        read_run_results(tmp_path)
