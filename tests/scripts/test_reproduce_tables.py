"""The rows of experiments are valid settings that change something, and a tiny data set gives a table."""

from __future__ import annotations

from pathlib import Path

import pytest
import reproduce_tables as script
from helpers.kitti_folder import write_data_set

from directshape_torch.cli.main import make_parser
from directshape_torch.io.config_files import load_config
from directshape_torch.refiner import DirectShapeRefiner


@pytest.mark.parametrize("table", sorted(script.TABLES))
def test_every_row_is_a_call_that_changes_something(table: str) -> None:
    rows = {name: row for name, row in script.TABLES[table].items() if name != script.BOX_ALIGNMENT}
    words = {name: script.words_of(row) for name, row in rows.items()}
    assert len({tuple(w) for w in words.values()}) == len(rows)
    needed = ["refine", "--data", "d", "--detections", "d", "--out", "o"]
    default = load_config(None, script.words_of("")[1:])
    for name, added in words.items():
        args = make_parser().parse_args([*needed, *added])
        config = load_config(args.config, args.set)
        others = (args.rig, args.prior) != ("auto", None)
        assert (config != default) or others or not rows[name]


def test_a_table_and_that_its_runs_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_data_set(tmp_path, ("000000",))
    for table in script.TABLES.values():
        monkeypatch.setitem(table, next(iter(table)), "'stages=[{max_iterations: 2}]'")
    words = ["ablation", "--data", str(tmp_path), "--detections", str(tmp_path / "detections" / "data"),
             "--masks", str(tmp_path / "masks"), "--out", str(tmp_path / "out")]  # fmt: skip
    assert script.main([*words, "--rows", "silhouette only"]) == 0
    table = (tmp_path / "out" / "ablation.md").read_text()
    assert capsys.readouterr().out == table
    assert [line.split(" | ")[0] for line in table.splitlines()[2:]] == [
        "| input",
        "| images alone",
        "| silhouette only",
    ]

    def refuse(*_arguments: object) -> None:
        raise AssertionError("refined again")

    with monkeypatch.context() as patched:
        patched.setattr(DirectShapeRefiner, "forward", refuse)
        assert script.main([*words, "--rows", "silhouette only"]) == 0
    assert (tmp_path / "out" / "ablation.md").read_text() == table
    assert script.main(["pose", *words[1:], "--rows", script.BOX_ALIGNMENT]) == 0
    assert (tmp_path / "out" / "box_alignment" / "data" / "000000.txt").is_file()
    assert f"| {script.BOX_ALIGNMENT} | " in (tmp_path / "out" / "pose.md").read_text()
    assert script.main([*words, "--rows", "nothing"]) == 2
    assert "silhouette only" in capsys.readouterr().err
