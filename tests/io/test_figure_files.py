"""Figures and animations: equal ones give equal bytes, and what is missing is named with how to get it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from directshape_torch.errors import MissingDependencyError
from directshape_torch.io.figure_files import check_figures, figure_png, new_figure, write_animation


def _png(last_value: float) -> bytes:
    figure = new_figure(4, 2, "a test")
    figure.add_subplot().plot([0, last_value])
    return figure_png(figure)


def test_bytes_depend_on_the_figure_alone() -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    assert _png(1.0) == _png(1.0)
    assert _png(1.0) != _png(2.0)


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"^a test needs .*pip install 'directshape_torch\[plot\]'"):
        new_figure(4, 2, "a test")
    with pytest.raises(MissingDependencyError, match=r"^a command needs .*pip install 'directshape_torch\[plot\]'"):
        check_figures("a command")


_RED, _BLUE = (np.full((12, 20, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 0, 255)))


def test_animation_read_back(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    write_animation(path, [_RED, _BLUE, _RED], [0.1, 0.2, 1.5])
    with Image.open(path) as animation:
        assert (animation.n_frames, animation.size, animation.info["loop"]) == (3, (20, 12), 0)
        for number, (picture, milliseconds) in enumerate(zip((_RED, _BLUE, _RED), (100, 200, 1500), strict=True)):
            animation.seek(number)
            assert animation.info["duration"] == milliseconds
            np.testing.assert_allclose(np.asarray(animation.convert("RGB")), picture, atol=8)


def test_without_pillow_the_cure_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingDependencyError, match=r"pillow.*directshape_torch\[plot\]"):
        write_animation(tmp_path / "a.gif", [_RED], [1.0])
