"""Figures of matplotlib: equal ones give equal bytes, and without matplotlib the message says how to get it."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from directshape_torch.errors import MissingDependencyError
from directshape_torch.io.figure_files import check_figures, figure_png, new_figure


def _png(last_value: float) -> bytes:
    figure = new_figure(4, 2, "a test")
    figure.add_subplot().plot([0, last_value])
    return figure_png(figure)


def test_bytes_depend_on_the_figure_alone() -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    assert _png(1.0) == _png(1.0)
    assert _png(1.0) != _png(2.0)


def test_size() -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    height, width = cv2.imdecode(np.frombuffer(_png(1.0), np.uint8), cv2.IMREAD_COLOR).shape[:2]
    assert width == 2 * height


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"^a test needs .*pip install 'directshape_torch\[plot\]'"):
        new_figure(4, 2, "a test")
    with pytest.raises(MissingDependencyError, match=r"^a command needs .*pip install 'directshape_torch\[plot\]'"):
        check_figures("a command")
