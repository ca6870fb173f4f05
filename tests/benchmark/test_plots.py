"""One picture for each quantity of a y axis."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.benchmark.plots import write_plots
from directshape_torch.benchmark.rows import Curve


def test_a_picture_for_each_y_axis_with_a_panel_for_each_quantity(tmp_path: Path) -> None:
    curves = [
        Curve(panel, "eager", panel, label, (1.0, 2.0), (3.0, 5.0))
        for panel in ("cars", "pixels")
        for label in ("time [ms]", "peak memory [MB]")
    ]

    paths = write_plots(tmp_path / "plots", curves)

    assert [path.name for path in paths] == ["time.png", "peak_memory.png"]
    assert all(path.read_bytes()[1:4] == b"PNG" for path in paths)
