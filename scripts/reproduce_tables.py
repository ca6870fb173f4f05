"""This script repeats the paper's experiments on a data set: average precision of every method, and the ablation.

    R=$DIRECTSHAPE_DATA/rendered
    python scripts/reproduce_tables.py pose --data $R --detections $R/detections/stereo --masks $R/training/masks
    python scripts/reproduce_tables.py ablation --data $R --detections $R/detections/stereo --masks $R/training/masks

A row is a call of `directshape refine` with the words beside its name below, or of `align_boxes.py`, in its own folder
under --out. A second call only makes the table, and an interrupted call continues. Other data, detections or masks need
another --out. A difference is the mean change of BEV IoU from the table's first row, of the same cars, with its 95 %
interval over cars. Every row of the ablation but one is refined from the images alone, so that a difference shows what
a term does and not how well the detector makes up for it.
"""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import align_boxes
import numpy as np
from command_line import markdown_table, run_command

from directshape_torch.cli.main import main as directshape
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.evaluation.bootstrap import CarBootstrap
from directshape_torch.evaluation.comparison import Comparison, compare_results
from directshape_torch.evaluation.kitti_ap import evaluate_kitti
from directshape_torch.evaluation.tables import number, with_interval
from directshape_torch.rig.rig_file import RIG_FILE

IMAGES_ALONE = "images alone"
BOX_ALIGNMENT = "box alignment"
METHODS = {
    "default": "",
    "input where not trusted": "--trusted",
    IMAGES_ALONE: "priors.detector_weight=0",
    "paper": "--config paper",
    "fast": "--config fast",
    "geometric": "--config geometric",
    "combined": "--config combined",
    BOX_ALIGNMENT: "align_boxes.py",
}
_COARSE = "{contour_width_px: 2.0, image_level: 1, max_iterations: 6, over_relaxation: 1.6, unknowns: pose}"
_FINE = "{contour_width_px: 0.5, image_level: 0, max_iterations: 6, over_relaxation: 1.6, unknowns: pose}"
_NO_GROUND = "priors.height_weight=0 priors.tilt_weight=0"
_ALONE = "priors.detector_weight=0"
ABLATION = {
    IMAGES_ALONE: _ALONE,
    "the detector's box as well (the default)": "",
    "rig taken to be exact": f"--rig none {_ALONE}",
    "silhouette only": f"photometric.weight=0 {_ALONE}",
    "photometric only": f"silhouette.weight=0 {_ALONE}",
    "the paper's product silhouette": f"silhouette.form=product {_ALONE}",
    "no priors at all": f"priors.shape_weight=0 priors.dimensions_weight=0 {_NO_GROUND} {_ALONE}",
    "no shape prior": f"priors.shape_weight=0 {_ALONE}",
    "no prior on dimensions (the paper)": f"priors.dimensions_weight=0 {_ALONE}",
    "no ground": f"{_NO_GROUND} {_ALONE}",
    "mean shape, pose only": f"'stages=[{_COARSE}, {_FINE}]' {_ALONE}",
    "network": f"--prior neural {_ALONE}",
    "no occlusion handling": f"sampling.occlusion=false {_ALONE}",
    "3000 pixels a car": f"sampling.min_pixels=3000 sampling.max_pixels=3000 {_ALONE}",
    "fine stage only": f"'stages=[{_FINE}]' {_ALONE}".replace("pose", "both"),
    "rays marched at every state": f"solver.rays=marched {_ALONE}",
}
TABLES = {"pose": METHODS, "ablation": ABLATION}


def words_of(row: str) -> list[str]:
    """The words that a row adds to a call of `directshape refine`: options or settings, with every result returned.

    Examples:
        >>> words_of("solver.rays=marched")[-1]
        'solver.rays=marched'
        >>> words_of("--trusted")
        []
    """
    if row == "--trusted":
        return []
    words, every = shlex.split(row), ["acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0"]
    options, settings = (words[:2], words[2:]) if row.startswith("-") else ([], words)
    return [*options, "--set", *every, *settings]


def first_row(args: argparse.Namespace) -> str:
    """The name of the row that the others are compared with."""
    return next(iter(TABLES[args.table]))


def folder_of(args: argparse.Namespace, name: str) -> Path:
    """The folder of a row."""
    return Path(args.out) / "".join(c if c.isalnum() else "_" for c in name)


def refined(args: argparse.Namespace, name: str) -> Path:
    """The folder of a row, which is refined now if it was not before.

    Raises:
        InputError: there is no such row.
        DirectShapeError: a run did not end well, as it has reported.
    """
    rows, out = TABLES[args.table], folder_of(args, name)
    if name not in rows:
        raise InputError("--rows", f"names among {', '.join(rows)}", name)
    data = ["--data", args.data, "--detections", args.detections, "--masks", args.masks, "--out", out]
    words = [*map(str, data), *([] if args.frames is None else ["--frames", *args.frames])]
    with contextlib.redirect_stdout(sys.stderr):
        if name == BOX_ALIGNMENT:
            # The rig is the one that the first row has estimated from the same frames.
            code = align_boxes.main([*words, "--rig", str(folder_of(args, first_row(args)) / RIG_FILE)])
        else:
            code = directshape(["refine", *words, *words_of(rows[name])])
    if code:
        raise DirectShapeError(f"the row {name!r} could not be refined, see above")
    return out


def run(args: argparse.Namespace) -> None:
    """Refine and compare row by row; print the table as Markdown and write it to `TABLE.md`."""
    first, lines = comparison(args, first_row(args)), []
    for when, name in (("before", "input"), ("after", first_row(args))):
        folder = args.detections if when == "before" else folder_of(args, name) / "data"
        lines.append([name, *box_cells(first, when), "", *ap_cells(args, folder)])
    for name in args.rows or TABLES[args.table]:
        if name != first_row(args):
            found = comparison(args, name)
            ap = ap_cells(args, folder_of(args, name) / "data")
            lines.append([name, *box_cells(found, "after"), difference(first, found), *ap])
    table = markdown_table(HEAD, lines) + "\n"
    (args.out / f"{args.table}.md").write_text(table, encoding="utf-8")
    print(table, end="")


HEAD = ("", "BEV IoU, mean", "3D IoU, mean", "worse", "against the first row",
        *(f"AP_R11 {metric} {iou}" for metric in ("BEV", "3D") for iou in (0.5, 0.7)))  # fmt: skip


def comparison(args: argparse.Namespace, name: str) -> Comparison:
    """A row's boxes compared with the labels, over the cars that have a mask."""
    out, labels, with_masks = refined(args, name), args.data / "training" / "label_2", folder_of(args, first_row(args))
    return compare_results(labels, args.detections, out / "data", frames=args.frames, shapes_dir=with_masks)


def box_cells(found: Comparison, when: str) -> list[str]:
    """Cells with mean IoUs and the share made worse."""
    bev, in_3d = (getattr(found.overall.metrics[key], when) for key in ("bev_iou_mean", "iou_3d_mean"))
    worse = found.overall.worse_share
    is_after = when == "after" and worse is not None
    return [with_interval("", bev), number("", in_3d.value), number("%", worse.value) if is_after else ""]


def difference(first: Comparison, found: Comparison) -> str:
    """Mean BEV IoU of a row less that of the first one, over the same cars in every draw."""
    cars = [{(car.frame_id, car.detection_line): car.after.bev_iou for car in side.cars} for side in (first, found)]
    common = sorted(set(cars[0]) & set(cars[1]))
    before, after = (np.array([side[key] for key in common]) for side in cars)
    return with_interval("", CarBootstrap(len(common)).summary(before, after).change, sign=True)


def ap_cells(args: argparse.Namespace, results: Path) -> list[str]:
    """Average precision over 11 recall points, moderate, as in the paper."""
    frames = args.frames or sorted(path.stem for path in (folder_of(args, first_row(args)) / "data").glob("*.txt"))
    scores = evaluate_kitti(args.data / "training" / "label_2", results, frames=frames)
    return [f"{scores.score(m, iou, 'moderate').ap_r11:.1f}" for m in ("bev", "3d") for iou in (0.5, 0.7)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=tuple(TABLES))
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="KITTI's layout, with labels")
    parser.add_argument("--detections", type=Path, required=True, metavar="DIR")
    parser.add_argument("--masks", type=Path, required=True, metavar="DIR")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all")
    parser.add_argument("--rows", nargs="+", metavar="NAME", help="of the table; default all")
    parser.add_argument("--out", type=Path, default=Path("out/tables"), metavar="DIR", help="default: %(default)s")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
