"""The names in docs/outputs.md are those of the code, and its Python for other programs runs."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from helpers.finished_run import FinishedRun

from directshape_torch.cli.inspect import _FIGURES
from directshape_torch.visualize.export_run import FORMATS
from directshape_torch.visualize.painted_cars import NEUTRAL_RGB
from directshape_torch.visualize.refinement_trace import RefinementTrace

DOCS = Path(__file__).parents[2] / "docs"
TEXT = (DOCS / "outputs.md").read_text(encoding="utf-8")
EXPORTS = TEXT[TEXT.index("## For other programs") :]


def test_pictures_are_small() -> None:
    for name in re.findall(r"\]\((images/[^)]+)\)", TEXT):
        assert (DOCS / name).stat().st_size < 700_000, name


def test_every_picture_of_inspect_is_listed() -> None:
    table = TEXT[TEXT.index("| file | shows |") : TEXT.index("## For other programs")]
    listed = set(re.findall(r"^\| `([\w.]+)` \|", table, re.MULTILINE))
    assert listed == {*_FIGURES, "iterations.gif"}


def test_what_a_trace_is_said_to_have_exists() -> None:
    known = {f.name for f in fields(RefinementTrace)} | {"T_cam_obj", "codes"}
    said = set(re.findall(r"^trace\.(\w+)", TEXT, re.MULTILINE))
    assert said
    assert said <= known


def test_every_format_has_a_row() -> None:
    table = TEXT[TEXT.index("| `--format` |") : TEXT.index("`cam` is the left")]
    assert tuple(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == tuple(FORMATS)


def test_the_grey_is_that_of_the_code() -> None:
    assert f"sRGB {NEUTRAL_RGB}" in EXPORTS


def test_the_python_example_runs(finished: FinishedRun, tmp_path: Path) -> None:
    code = "".join(re.findall(r"```python\n(.*?)```", EXPORTS, re.DOTALL))
    places = {
        '"OUT"': finished.out,
        '"pca"': finished.root / "prior.safetensors",
        '"ROOT"': finished.root,
        '"DETECTIONS"': finished.root / "detections",
        '"MASKS"': finished.root / "masks",
        '"EXPORTS"': tmp_path,
    }
    for name, place in places.items():
        assert name in code
        code = code.replace(name, repr(str(place)))
    names: dict[str, object] = {}
    exec(code, names)
    assert (tmp_path / "glb" / "000001.glb").is_file()
    assert (tmp_path / "kitti" / "json" / "000001.json").is_file()
