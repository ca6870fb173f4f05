"""The documented formats are those that the code writes."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from helpers.ellipsoids import ellipsoid_prior
from helpers.kitti_folder import input_options, write_data_set
from safetensors.torch import load_file

from directshape_torch.cli.main import main
from directshape_torch.io.result_files import SHAPES_SCHEMA_VERSION
from directshape_torch.io.run_manifest import MANIFEST_SCHEMA_VERSION
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance, read_description
from directshape_torch.status import Status

TEXT = (Path(__file__).parent.parent.parent / "docs" / "file_formats.md").read_text(encoding="utf-8")


def section(heading: str) -> str:
    """The text below a heading, up to the next one."""
    found = re.search(rf"^#+ [^\n]*{re.escape(heading)}[^\n]*\n(.*?)(?=^#|\Z)", TEXT, flags=re.MULTILINE | re.DOTALL)
    assert found is not None, f"no heading with {heading!r}"
    return found[0]


def table_names(text: str) -> set[str]:
    """The words in code type in the first column of a table."""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("|")]
    return {name for cell in cells for name in re.findall(r"`([^`]+)`", cell)}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root, out = (tmp_path_factory.mktemp(name) for name in ("kitti", "out"))
    write_data_set(root, ("000000", "000001"))
    (root / "training" / "image_2" / "000001.png").write_bytes(b"no image")
    settings = ["--set", "stages=[{max_iterations: 1}]"]
    assert main(["refine", *input_options(root), "--out", str(out), *settings]) == 1
    return out


def test_shapes(out: Path) -> None:
    text = section("shapes/NNNNNN.npz")
    assert f"schema {SHAPES_SCHEMA_VERSION}" in text
    with np.load(out / "shapes" / "000000.npz", allow_pickle=False) as file:
        assert table_names(text) == set(file.files)
    for status in Status:
        assert f"`{status.name}`" in text


def test_summary(out: Path) -> None:
    text = section("`summary.json`")
    assert f"schema {MANIFEST_SCHEMA_VERSION}" in text
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == ["000000", "000001"]
    for part in (summary, summary["config"], summary["sha256"]):
        for name in part:
            assert f'"{name}"' in text, name


def test_timings(out: Path) -> None:
    text = section("`timings.json`")
    timings = json.loads((out / "timings.json").read_text())
    for name in (*timings, *timings["calls"][0]):
        assert f'"{name}"' in text


def test_prior(tmp_path: Path) -> None:
    text = section("Shape prior")
    assert PCAShapePrior.SCHEMA in text
    ellipsoid_prior().save(tmp_path / "prior.safetensors")
    description = read_description(tmp_path / "prior.safetensors")
    assert table_names(text) == {*load_file(tmp_path / "prior.safetensors"), *description}
    for field in fields(PriorProvenance):
        assert f"`{field.name}`" in text
