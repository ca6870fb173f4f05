"""The judged cars as text, CSV and a scatter plot."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple, fields

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.figure_files import figure_png, new_figure
from label_disparity.judgement import JudgedCar
from label_disparity.measurement import spread

ERROR_COLUMNS = [
    "MAD [px]",
    "n",
    "image",
    "image SD",
    "expected SD",
    "centre",
    "- image",
    "corr.",
    "side",
    "- image",
    "corr.",
]
OVERLAP_COLUMNS = ["mean BEV IoU", "n", "refined", "moved", "placebo", "label's length", "both"]


def report(cars: Sequence[JudgedCar], num_unmeasured: int) -> str:
    """One line for each car, then one for each group in two tables."""
    lines = ["frame   label      z    n  image            centre    side  BEV IoU  moved  car"]
    lines += [_car_line(car) for car in cars]
    lines += ["", f"{len(cars)} cars measured; {num_unmeasured} more have too few patches", ""]
    groups = _groups(cars)
    lines += align([ERROR_COLUMNS, *([name, *_error_cells(group)] for name, group in groups)])
    lines += ["", *align([OVERLAP_COLUMNS, *([name, *_overlap_cells(group)] for name, group in groups)])]
    return "\n".join(lines) + "\n"


def _car_line(car: JudgedCar) -> str:
    return (
        f"{car.frame_id:7s} {car.label_line:5d} {car.depth_m:6.1f} {car.num_patches:4d} "
        f"{car.image_px:+.3f} +-{car.image_sigma_px:.3f}  {car.centre_px:+.3f}  {car.side_px:+.3f} "
        f"{car.bev_iou:8.3f} {car.bev_iou_moved:6.3f}  {car.car}"
    )


def _groups(cars: Sequence[JudgedCar]) -> list[tuple[str, list[JudgedCar]]]:
    """All cars, each drive, and each physical car of a drive."""
    drives = sorted({car.drive for car in cars if car.drive})
    names = sorted({car.car for car in cars if car.drive})
    return [
        ("all", list(cars)),
        *((drive, [c for c in cars if c.drive == drive]) for drive in drives),
        *((name, [c for c in cars if c.car == name]) for name in names),
    ]


def _error_cells(cars: Sequence[JudgedCar]) -> list[str]:
    image, sigma, centre, side = (
        np.array([getattr(car, name) for car in cars])
        for name in ("image_px", "image_sigma_px", "centre_px", "side_px")
    )
    # A refined box may miss the label's pixels altogether; then it has no side to compare.
    on_side = np.isfinite(side)
    expected = np.sqrt(np.mean(sigma**2))
    cells = [str(len(cars)), f"{spread(image):.3f}", f"{image.std():.3f}", f"{expected:.3f}"]
    for error, used in ((centre, np.ones_like(on_side)), (side, on_side)):
        cells += [f"{spread(error[used]):.3f}", f"{spread((error - image)[used]):.3f}"]
        cells.append(f"{correlation(image[used], error[used]):+.2f}")
    return cells


def _overlap_cells(cars: Sequence[JudgedCar]) -> list[str]:
    names = ("bev_iou", "bev_iou_moved", "bev_iou_of_placebo", "bev_iou_full_length", "bev_iou_both")
    return [str(len(cars)), *(f"{np.mean([getattr(car, name) for car in cars]):.3f}" for name in names)]


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column to the left and the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(
            f"{cell:<{width}s}" if k == 0 else f"{cell:>{width}s}"
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Pearson's, NaN for fewer than three cars or no variation."""
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])


def csv_text(cars: Sequence[JudgedCar]) -> str:
    """One line for each car; columns are the fields of `JudgedCar`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(JudgedCar)])
    writer.writerows([f"{v:.5g}" if isinstance(v, float) else v for v in astuple(car)] for car in cars)
    return text.getvalue()


def scatter_png(cars: Sequence[JudgedCar]) -> bytes:
    """Errors of the refined cars over the disagreement of label and image, one colour for each physical car.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(10, 5, "the scatter plot")
    titles = {"centre_px": "depth of the refined centre", "side_px": "refined visible side"}
    for axes, (name, title) in zip(figure.subplots(1, 2), titles.items(), strict=True):
        for group, members in _plot_groups(cars):
            x, y, sigma = (np.array([getattr(c, key) for c in members]) for key in ("image_px", name, "image_sigma_px"))
            axes.errorbar(x, y, xerr=sigma, fmt="o", markersize=4, linewidth=0.7, label=group)
        axes.axline((0, 0), slope=1, color="grey", linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("image minus label [px]")
        axes.set_ylabel("refined minus label [px]")
        axes.set_title(title)
        axes.legend(fontsize="small")
    return figure_png(figure)


def _plot_groups(cars: Sequence[JudgedCar]) -> list[tuple[str, list[JudgedCar]]]:
    named = [group for group in _groups([c for c in cars if c.drive])[1:] if "/" in group[0]]
    other = [c for c in cars if not c.drive]
    return [*named, ("others", other)] if other else named
