"""The fixed parts of the page: template, style and programs, put inline so that the page asks for nothing."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from importlib.resources import files

_REPORT = files("directshape_torch") / "assets" / "report"
_THREE = files("directshape_torch") / "assets" / "vendor" / "three"

_CORE_FILE, _CORE_NAME = '"./three.core.min.js"', '"three/core"'


def page_frame(title: str) -> tuple[str, str]:
    """The fixed parts of a page: what comes before its data and after it.

    The content security policy names the page's own inline scripts by their hash and lets nothing be loaded: a script
    or handler that came in with the data would not run even if it were not escaped.

    Args:
        title: text of the page's title; escaped here.
    """
    import_map = json.dumps({"imports": _modules()}, separators=(",", ":"))
    start = 'import "report/main";'
    style = _asset("style.css")
    policy = (
        "default-src 'none'; img-src data:; connect-src 'none'; form-action 'none'; base-uri 'none'; "
        f"style-src {_hash(style)}; script-src data: {_hash(import_map)} {_hash(start)}"
    )
    values = {
        "title": html.escape(title),
        "policy": html.escape(policy, quote=True),
        "style": style,
        "import_map": import_map,
        "start": start,
    }
    head, foot = (_filled(part, values) for part in _asset("page.html").split("{{data}}"))
    return head, foot


def _filled(template: str, values: Mapping[str, str]) -> str:
    """All places filled in one pass: a value that looks like a place stays as it is."""
    return re.sub(r"\{\{(\w+)\}\}", lambda place: values[place[1]], template)


def data_block(name: str, value: object) -> str:
    """JSON that the page reads by name; no text in it can end its element.

    Examples:
        >>> data_block("cars", ["</script>"]).count("<")
        2
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return f'<script type="application/json" id="data-{name}">{text}</script>\n'


def _modules() -> dict[str, str]:
    """Each module by the name it is imported by, as a data URL: pages of file:// may import no other files."""
    core, renderer, controls = (
        (_THREE / name).read_text("utf-8") for name in ("three.core.min.js", "three.module.min.js", "OrbitControls.js")
    )
    if _CORE_FILE not in renderer:
        raise RuntimeError(f"three.module.min.js does not import {_CORE_FILE}: bring page_assets.py up to date")
    own = sorted(file.name for file in _REPORT.iterdir() if file.name.endswith(".js"))
    sources = {
        "three/core": core,
        "three": renderer.replace(_CORE_FILE, _CORE_NAME),
        "three/orbit-controls": controls,
        **{f"report/{name.removesuffix('.js')}": _asset(name) for name in own},
    }
    return {name: _data_url(source) for name, source in sources.items()}


def _asset(name: str) -> str:
    return (_REPORT / name).read_text("utf-8")


def _data_url(source: str) -> str:
    return "data:text/javascript;base64," + base64.b64encode(source.encode()).decode("ascii")


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"
