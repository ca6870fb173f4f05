"""The search of the documentation works in pages opened from a folder, without a network."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.browser import chromium, console_problems, requested_urls

SHIM = Path(__file__).parents[2] / "docs" / "javascripts" / "iframe-worker.js"
CONFIG = """
site_name: site
use_directory_urls: false
theme: {name: material, font: false}
extra: {polyfills: [javascripts/iframe-worker.js]}
plugins: [search, offline]
"""


def test_search(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="needs mkdocs-material (the extra docs)")
    assert "polyfills: [javascripts/iframe-worker.js]" in (SHIM.parents[2] / "mkdocs.yml").read_text("utf-8")
    (tmp_path / "docs" / "javascripts").mkdir(parents=True)
    shutil.copy(SHIM, tmp_path / "docs" / "javascripts")
    (tmp_path / "docs" / "index.md").write_text("# Start\n\nNothing here.\n")
    (tmp_path / "docs" / "other.md").write_text("# Another page\n\nAbout zebras.\n")
    (tmp_path / "mkdocs.yml").write_text(CONFIG)
    subprocess.run([sys.executable, "-m", "mkdocs", "build", "--quiet"], cwd=tmp_path, check=True, capture_output=True)
    with chromium() as browser:
        browser.get((tmp_path / "site" / "index.html").as_uri())
        browser.execute_script(
            """document.querySelector("#__search").click();
            const box = document.querySelector("input[name=query]");
            box.value = "zebras";
            box.focus();
            box.dispatchEvent(new KeyboardEvent("keyup"));"""
        )
        end = time.monotonic() + 20
        while not browser.find_elements("css selector", ".md-search-result__item"):
            assert time.monotonic() < end, "nothing was found"
            time.sleep(0.1)
        found = browser.execute_script("return document.querySelector('.md-search-result__item').textContent")
        assert "Another page" in found
        assert console_problems(browser) == []
        assert all(url.startswith(("file:", "data:", "about:")) for url in requested_urls(browser))
