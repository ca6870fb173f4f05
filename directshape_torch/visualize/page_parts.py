"""This module joins template, style, scripts and data into one page that loads no other files.

Numbers are rounded; meshes and pictures are packed as text.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
import zlib
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from directshape_torch.visualize.drawing import Picture

_REPORT = files("directshape_torch") / "assets" / "report"
_THREE = files("directshape_torch") / "assets" / "vendor" / "three"

_CORE_FILE, _CORE_NAME = '"./three.core.min.js"', '"three/core"'

FRAME_QUALITY = 80
_SMALL_QUALITY = 85
_PER_METRE = 1000


def page_frame(title: str) -> tuple[str, str]:
    """The fixed parts of a page, before and after its data.

    The content security policy names the hashes of the page's own inline scripts and permits no loading. A script or
    handler in the data would not run even if it were not escaped.
    """
    import_map = json.dumps({"imports": _modules()}, separators=(",", ":"))
    start = 'import "report/main";'
    style = _asset("style.css")
    policy = (
        "default-src 'none'; img-src data:; connect-src 'none'; form-action 'none'; base-uri 'none'; "
        f"style-src {_hash(style)}; script-src data: {_hash(import_map)} {_hash(start)}"
    )
    values = {"title": html.escape(title), "policy": html.escape(policy, quote=True), "style": style}
    values |= {"import_map": import_map, "start": start}
    parts = _asset("page.html").split("{{data}}")
    # All placeholders are replaced in one pass, so that a value with the form of a placeholder stays unchanged.
    head, foot = (re.sub(r"\{\{(\w+)\}\}", lambda place: values[place[1]], part) for part in parts)
    return head, foot


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
    """Each module as a data URL by its import name, because pages of file:// cannot import other files."""
    core, renderer, controls = (
        (_THREE / name).read_text("utf-8") for name in ("three.core.min.js", "three.module.min.js", "OrbitControls.js")
    )
    if _CORE_FILE not in renderer:
        raise RuntimeError(f"three.module.min.js does not import {_CORE_FILE}: bring page_parts.py up to date")
    own = sorted(file.name for file in _REPORT.iterdir() if file.name.endswith(".js"))
    sources = {
        "three/core": core,
        "three": renderer.replace(_CORE_FILE, _CORE_NAME),
        "three/orbit-controls": controls,
        **{f"report/{name.removesuffix('.js')}": _asset(name) for name in own},
    }
    packed_sources = {name: base64.b64encode(source.encode()).decode("ascii") for name, source in sources.items()}
    return {name: f"data:text/javascript;base64,{text}" for name, text in packed_sources.items()}


def _asset(name: str) -> str:
    return (_REPORT / name).read_text("utf-8")


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"


def known(value: float | np.floating[Any] | None, decimals: int = 4) -> float | None:
    """A number for JSON, rounded, or None if it is not finite.

    Examples:
        >>> known(0.123456), known(float("nan"))
        (0.1235, None)
    """
    return None if value is None or not math.isfinite(value) else round(float(value), decimals)


def numbers(values: Sequence[float] | npt.NDArray[np.floating[Any]], decimals: int = 5) -> list[float | None]:
    """Numbers for JSON, rounded, with None for values that are not finite."""
    return [known(value, decimals) for value in values]


def mesh_data(vertices_obj: npt.NDArray[Any], faces: npt.NDArray[Any]) -> dict[str, str]:
    """A mesh in the object frame, about 7 bytes for each vertex, in the format that the page's `mesh.js` reads.

    `vertices` has x of all vertices in millimetres, then y, then z; `faces` has corners, triangle by triangle. Both are
    int32, little-endian, as differences of consecutive numbers, compressed by zlib, in base64.
    """
    millimetres = np.round(vertices_obj * _PER_METRE).astype(np.int64)
    return {"vertices": packed(millimetres.T.reshape(-1)), "faces": packed(faces.reshape(-1))}


def packed(numbers: npt.NDArray[np.integer[Any]]) -> str:
    """Whole numbers as text; consecutive numbers of a mesh differ by little, and small differences compress well."""
    differences = np.diff(numbers.astype(np.int64), prepend=0).astype("<i4")
    return base64.b64encode(zlib.compress(differences.tobytes(), 9)).decode("ascii")


def data_url(picture: Picture, quality: int = _SMALL_QUALITY) -> str:
    """A picture (h, w, 3) as WebP in a data URL; `OSError` is raised if OpenCV cannot encode it."""
    encoded, content = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not encoded:
        raise OSError(f"cannot encode a picture of shape {picture.shape} as WebP")
    return "data:image/webp;base64," + base64.b64encode(content.tobytes()).decode("ascii")
