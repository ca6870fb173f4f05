"""Legends of a row of panels hide no curve and lie within the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from directshape_torch.errors import InputError
from directshape_torch.visualize import panel_row

LONG = tuple(f"a method with a long name, number {k}" for k in range(7))


def _draw(axes: Any, names: tuple[str, ...]) -> None:
    for name in names:
        axes.plot([0, 1], [0, 1], label=name)
    axes.set(title="a title", xlabel="recall", ylabel="precision")


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every figure that is written."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    seen: list[Any] = []
    png_of = panel_row.figure_png

    def remember(figure: Any) -> bytes:
        seen.append(figure)
        return png_of(figure)

    monkeypatch.setattr(panel_row, "figure_png", remember)
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
    panel_row.write_panel_row(tmp_path / "a.png", panels, _draw, "title", 3.6, "a test")
    (figure,) = figures
    own = [axes.get_legend() for axes in figure.axes if axes.get_legend() is not None]
    assert (len(figure.legends), len(own)) == (num_shared, num_own)
    for legend in [*figure.legends, *own]:
        box = legend.get_window_extent()
        assert box.x0 >= figure.bbox.x0
        assert box.x1 <= figure.bbox.x1
        assert box.y0 >= figure.bbox.y0
        assert all(box.y1 <= axes.get_window_extent().y0 for axes in figure.axes)


def test_every_panel_keeps_its_size_however_long_the_legend(tmp_path: Path, figures: list[Any]) -> None:
    for names in (LONG[:1], LONG):
        panel_row.write_panel_row(tmp_path / "a.png", [names], _draw, "title", 3.6, "a test")
    few, many = (figure.axes[0].get_window_extent() for figure in figures)
    assert many.height == pytest.approx(few.height, rel=0.1)


def test_no_panels(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="panels: expected at least one, got none"):
        panel_row.write_panel_row(tmp_path / "a.png", [], _draw, "title", 3.6, "a test")
    assert not (tmp_path / "a.png").exists()
