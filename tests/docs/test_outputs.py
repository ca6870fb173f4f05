"""docs/outputs.md: its names are those of the code, and its Python runs."""

from __future__ import annotations

import re
from pathlib import Path

from helpers.finished_run import FinishedRun

from directshape_torch.export.box_files import DETECTION_NAMES, KITTI_TYPES
from directshape_torch.export.export_run import FORMATS
from directshape_torch.export.painted_cars import NEUTRAL_RGB

TEXT = (Path(__file__).parent.parent.parent / "docs" / "outputs.md").read_text(encoding="utf-8")


def test_every_format_has_a_row() -> None:
    table = TEXT[TEXT.index("| `--format` |") : TEXT.index("`cam` is the left")]
    assert tuple(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == tuple(FORMATS)


def test_names_are_those_of_the_code() -> None:
    flat = " ".join(TEXT.split())
    numbered = ", ".join(f"{number} {name.lower()}" for number, name in enumerate(KITTI_TYPES, start=1))
    assert f"Categories: {numbered}." in flat
    assert f"sRGB {NEUTRAL_RGB}" in flat
    for name in DETECTION_NAMES.values():
        assert f"`{name}`" in flat


def test_the_python_example_runs(finished: FinishedRun, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", TEXT[TEXT.index("## Export from Python") :], re.DOTALL)
    places = {
        '"OUT"': finished.out,
        '"pca"': finished.root / "prior.npz",
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
    assert (tmp_path / "nuscenes.json").is_file()
