"""The built pages have no formula left that a browser would show as text."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONFIG = """
site_name: site
docs_dir: {docs}
hooks: [{hook}]
use_directory_urls: false
theme: {{name: material, font: false}}
plugins: []
markdown_extensions: [tables, {{"pymdownx.arithmatex": {{generic: true}}}}]
"""


def test_every_formula_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("latex2mathml", reason="needs latex2mathml (the extra docs)")
    pytest.importorskip("material", reason="needs mkdocs-material (the extra docs)")
    pages = sorted((ROOT / "docs" / "derivations").glob("*.md"))
    config = CONFIG.format(docs=ROOT / "docs" / "derivations", hook=ROOT / "docs" / "formulas.py")
    (tmp_path / "mkdocs.yml").write_text(config)
    subprocess.run([sys.executable, "-m", "mkdocs", "build", "--quiet"], cwd=tmp_path, check=True, capture_output=True)
    for page in pages:
        name = "index" if page.stem == "README" else page.stem
        text = (tmp_path / "site" / f"{name}.html").read_text(encoding="utf-8")
        drawn = re.sub(r"<code>.*?</code>|<script.*?</script>", "", text, flags=re.DOTALL)
        assert "$" not in drawn, name
        # What the converter does not know it writes as text.
        assert "\\" not in drawn, name
        assert drawn.count("<math") == formulas_of(page), name
        # Chromium draws no `menclose`, and without a mathematical font no bracket of a given size.
        assert "<menclose" not in drawn, name
        assert "minsize" not in drawn, name
        assert drawn.count('class="boxed"') == page.read_text(encoding="utf-8").count(r"\boxed"), name


def formulas_of(page: Path) -> int:
    text = re.sub(r"`[^`]+`", "", page.read_text(encoding="utf-8"))
    blocks, rest = re.findall(r"\$\$.*?\$\$", text, re.DOTALL), re.sub(r"\$\$.*?\$\$", "", text, flags=re.DOTALL)
    return len(blocks) + len(re.findall(r"\$[^$]+\$", rest))
