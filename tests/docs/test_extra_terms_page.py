"""docs/extra_terms.md and docs/how_it_works.md name parts that exist."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

from directshape_torch.terms.lidar import LidarPoints

ROOT = Path(__file__).parents[2]
TERMS = (ROOT / "docs" / "extra_terms.md").read_text(encoding="utf-8")
WALK = (ROOT / "docs" / "how_it_works.md").read_text(encoding="utf-8")


def test_the_settings_of_lidar_are_those_of_the_code() -> None:
    assert f"Weight ({LidarPoints().weight:.0f}) and Huber corner ({LidarPoints().huber_m} m)" in " ".join(
        TERMS.split()
    )


def test_the_snippet_is_the_prior_and_its_factory() -> None:
    found = re.search(r'--8<-- "(examples/\w+\.py):(\d+):(\d+)"', TERMS)
    assert found is not None
    lines = (ROOT / found[1]).read_text(encoding="utf-8").splitlines()[int(found[2]) - 1 : int(found[3])]
    assert lines[0].startswith("def upright(")
    assert lines[-2 if not lines[-1] else -1].strip().startswith("return PriorTerm(")


def test_the_walk_names_files_that_exist() -> None:
    package = ROOT / "directshape_torch"
    folder = package
    for line in WALK.splitlines():
        if line.startswith("## "):
            named = re.findall(r"`(\w+)/`", line)
            folder = package / named[-1] if named else package
        for name in re.findall(r"`([\w/]+\.py)`", line):
            assert (package / name).is_file() or (folder / name).is_file(), (name, line)


def test_the_picture_has_the_layers_that_imports_obey() -> None:
    imports = configparser.ConfigParser()
    imports.read(ROOT / ".importlinter")
    layers = imports["importlinter:contract:layers"]["layers"].split("\n")
    picture = (ROOT / "docs" / "images" / "architecture.svg").read_text(encoding="utf-8")
    drawn = re.findall(r'class="layer"[^>]*>([^<]+)<', picture)
    assert drawn == [layer.strip().replace(" | ", ", ") for layer in layers if layer.strip(" _") not in ("", "main")]
