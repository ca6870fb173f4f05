"""The page loads nothing, runs only its own scripts, shows names as text and packs meshes without loss."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from importlib.resources import files

import numpy as np
from helpers.finished_run import unpacked
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.visualize.drawn_car import mean_car
from directshape_torch.visualize.page_parts import data_block, mesh_data, packed, page_frame

THREE = files("directshape_torch") / "assets" / "vendor" / "three"
HOSTILE = '"><script>boom()</script><!-- {{data}} {{style}} \\u2028 </title>'


def import_map(page: str) -> dict[str, str]:
    found = re.search(r'<script type="importmap">(.*?)</script>', page, re.DOTALL)
    urls: dict[str, str] = json.loads(found[1])["imports"]
    return urls


def source_of(url: str) -> str:
    head, _, content = url.partition(",")
    assert head == "data:text/javascript;base64"
    return base64.b64decode(content).decode()


def test_every_import_is_in_the_map() -> None:
    head, foot = page_frame("a run")
    modules = {name: source_of(url) for name, url in import_map(head).items()}
    for name, source in modules.items():
        without_comments = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
        imported = re.findall(r'(?:\bfrom\s*|\bimport\s*\(?)["\']([^"\']+)["\']', without_comments)
        assert set(imported) <= set(modules), name
    assert 'import "report/main"' in foot


def test_nothing_is_loaded_from_outside() -> None:
    text = "".join(page_frame("a run"))
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', text)
    assert "@import" not in text
    assert "url(" not in text
    own = [source_of(url) for name, url in import_map(text).items() if name.startswith("report/")]
    assert not [source for source in own if re.search(r"https?://(?!www\.w3\.org/2000/svg)|fetch\(|innerHTML", source)]


def test_the_policy_names_what_runs() -> None:
    text = "".join(page_frame("a run"))
    found = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    policy = html.unescape(found[1])
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    inline = re.findall(r'<(?:script type="(?:module|importmap)"|style)>(.*?)</(?:script|style)>', text, re.DOTALL)
    assert len(inline) == 3
    for content in inline:
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_a_hostile_title_stays_text() -> None:
    head, foot = page_frame(HOSTILE)
    title = re.search(r"<title>(.*?)</title>", head, re.DOTALL)
    assert html.unescape(title[1]) == HOSTILE
    assert "<script>boom" not in head + foot


@settings(max_examples=25)
@given(st.text())
def test_data_comes_back_as_it_was(text: str) -> None:
    text = text.encode("utf-8", "replace").decode("utf-8")
    block = data_block("x", [HOSTILE, text])
    found = re.fullmatch(r'<script type="application/json" id="data-x">([^<>&]*)</script>\n', block)
    assert json.loads(found[1]) == [HOSTILE, text]


def test_vendored_files_are_those_of_the_list() -> None:
    rows = re.findall(r"^\| `([^`]+)` \| `[^`]+` \| `([0-9a-f]{64})` \|$", (THREE / "README.md").read_text(), re.M)
    assert {name for name, _ in rows} == {"three.core.min.js", "three.module.min.js", "OrbitControls.js", "LICENSE"}
    for name, digest in rows:
        assert hashlib.sha256((THREE / name).read_bytes()).hexdigest() == digest
    assert "MIT License" in (THREE / "LICENSE").read_text()


@settings(max_examples=50)
@given(st.lists(st.integers(-(2**30), 2**30 - 1)))
def test_numbers_come_back(numbers: list[int]) -> None:
    assert unpacked(packed(np.array(numbers, dtype=np.int64))).tolist() == numbers


def test_a_car_is_small() -> None:
    mesh = mean_car(PCAShapePrior.load_bundled())
    data = mesh_data(mesh.vertices, mesh.faces)
    assert np.abs(unpacked(data["vertices"]).reshape(3, -1).T / 1000 - mesh.vertices).max() <= 0.0005 + 1e-9
    assert len(data["vertices"]) + len(data["faces"]) < 25_000
