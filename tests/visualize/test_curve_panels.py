"""Rows of panels with curves: equal curves give equal bytes; legends hide no curve and lie within the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from directshape_torch.errors import InputError
from directshape_torch.visualize import curve_panels
from directshape_torch.visualize.curve_panels import Curve, CurvePanel, write_curve_panels

LONG = tuple(f"a method with a long name, number {k}" for k in range(7))


def panel(*names: str, end: float = 1.0) -> CurvePanel:
    x = np.linspace(0, 1, 41)
    curves = tuple(Curve(name, x, x * end, x * end - 0.1, x * end + 0.1) for name in names)
    return CurvePanel("recall", "precision", curves, "a title")


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every figure that is written."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    seen: list[Any] = []
    write = curve_panels.write_figure

    def remember(path: Path, figure: Any) -> None:
        seen.append(figure)
        write(path, figure)

    monkeypatch.setattr(curve_panels, "write_figure", remember)
    return seen


@pytest.mark.parametrize(
    ("panels", "num_shared", "num_own"),
    [
        ([("easy", "hard")] * 3, 1, 0),
        ([LONG] * 2, 1, 0),
        ([("easy (90.0)", "hard (80.0)"), ("easy (95.0)", "hard (85.0)")], 0, 2),
        ([LONG, LONG[:2]], 0, 2),
    ],
)
def test_legends_lie_below_the_panels(
    tmp_path: Path, figures: list[Any], panels: list[tuple[str, ...]], num_shared: int, num_own: int
) -> None:
    write_curve_panels(tmp_path / "a.png", [panel(*names) for names in panels], "title")
    (figure,) = figures
    own = [axes.get_legend() for axes in figure.axes if axes.get_legend() is not None]
    assert (len(figure.legends), len(own)) == (num_shared, num_own)
    for legend in [*figure.legends, *own]:
        box = legend.get_window_extent()
        assert box.x0 >= figure.bbox.x0
        assert box.x1 <= figure.bbox.x1
        assert box.y0 >= figure.bbox.y0
        assert all(box.y1 <= axes.get_window_extent().y0 for axes in figure.axes)


def test_every_panel_keeps_its_size(tmp_path: Path, figures: list[Any]) -> None:
    write_curve_panels(tmp_path / "1.png", [panel(LONG[0])], "title")
    write_curve_panels(tmp_path / "3.png", [panel(LONG[0])] * 3, "title")
    write_curve_panels(tmp_path / "long.png", [panel(*LONG)], "title")
    few, _, many = (figure.axes[0].get_window_extent() for figure in figures)
    assert many.height == pytest.approx(few.height, rel=0.1)
    one, three = (cv2.imread(str(tmp_path / f"{count}.png")) for count in (1, 3))
    assert three.shape[1] == pytest.approx(3 * one.shape[1], abs=2)


def test_equal_curves_give_equal_bytes_and_others_do_not(tmp_path: Path) -> None:
    for name, end in (("a", 1.0), ("b", 1.0), ("c", 0.5)):
        write_curve_panels(tmp_path / name, [panel("easy", end=end)], "Car")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a").read_bytes() != (tmp_path / "c").read_bytes()


def test_no_panels(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="panels: expected at least one, got none"):
        write_curve_panels(tmp_path / "a.png", [], "title")
    assert not (tmp_path / "a.png").exists()
