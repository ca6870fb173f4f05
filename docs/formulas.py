"""A hook of mkdocs: formulas become MathML, which browsers draw without a script and without a network."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
_BOXED = re.compile(r'<menclose notation="box">(.*?)</menclose>')
_TALL = re.compile(r'<mo[^>]* minsize="([\d.]+)em"[^>]*>(.*?)</mo>')


def on_page_content(content: str, **_: Any) -> str:
    """The page with what `pymdownx.arithmatex` marked as a formula drawn."""
    blocks = _BLOCK.sub(lambda found: _mathml(found[1], "block"), content)
    return _INLINE.sub(lambda found: _mathml(found[1], "inline"), blocks)


def _mathml(formula: str, display: str) -> str:
    """A formula in the part of MathML that all browsers draw, which has no `menclose`."""
    drawn = _TALL.sub(_tall, convert(html.unescape(formula), display=display))
    return _BOXED.sub(r'<mrow class="boxed">\1</mrow>', drawn)


def _tall(found: re.Match[str]) -> str:
    """A bracket in larger type, because a browser stretches brackets of a given size only with a mathematical font."""
    size = float(found[1])
    # The middle of a bracket lies a quarter of its size above the line of the text.
    lower = f'<mpadded voffset="{0.25 - 0.25 * size:.3f}em">'
    return f'{lower}<mo stretchy="false" style="font-size: {size}em">{found[2]}</mo></mpadded>'
