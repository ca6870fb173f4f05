"""Table, per-car CSV and learning curves of a training."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

from directshape_torch.evaluation.bootstrap import BootstrapSettings
from directshape_torch.io.figure_files import figure_png, new_figure
from refiner_training.evaluation import Variant, table_row
from refiner_training.jobs import Kind, Options, Outcome, folds_of
from refiner_training.networks import TERMS

HEADER = (
    "",
    "BEV IoU, mean",
    "> 0.7",
    "centre, median",
    "worse than input",
    "BEV IoU against fixed",
    "worse than fixed",
)
_NAMES: dict[Kind, str] = {"fixed": "fixed default", "constant": "trained constants", "network": "trained network"}


def variants_of(outcomes: Sequence[Outcome]) -> list[Variant]:
    """Rows of the table: all cars in the same order, each judged by the training that had not seen its frame."""
    by_kind: dict[Kind, list[Outcome]] = {}
    for outcome in outcomes:
        by_kind.setdefault(outcome.job.kind, []).append(outcome)
    return [
        Variant(_NAMES[kind], tuple(sorted((car for o in parts for car in o.cars), key=lambda car: car.car)))
        for kind, parts in by_kind.items()
    ]


def markdown(outcomes: Sequence[Outcome], options: Options, wall_s: float) -> str:
    """The table and how it was made."""
    variants = variants_of(outcomes)
    settings = BootstrapSettings(seed=options.training.seed)
    fixed, constants, network = variants
    rows = [table_row(variant, fixed, settings) for variant in variants]
    pair = table_row(network, constants, settings)
    lines = [
        f"{len(fixed.cars)} cars, {options.folds} folds of frames, each car judged by the training that had not seen "
        f"its frame; {options.parts}, {options.mode}, {options.training.epochs} epochs, seed {options.training.seed}, "
        f"{wall_s:.0f} s",
        "",
        "| " + " | ".join(HEADER) + " |",
        "|---" * len(HEADER) + "|",
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
        f"Network against constants: {pair[5]}, worse {pair[6]}.",
        "",
        *_gradient_lines(outcomes),
        *_factor_lines(outcomes),
    ]
    return "\n".join(lines) + "\n"


def _gradient_lines(outcomes: Sequence[Outcome]) -> list[str]:
    lines = []
    for kind in ("constant", "network"):
        epochs = [epoch for o in outcomes if o.job.kind == kind for epoch in o.epochs]
        reached, missing = (sum(getattr(e, n) for e in epochs) for n in ("with_gradient", "without_gradient"))
        share = 100 * missing / max(1, reached + missing)
        lines.append(
            f"- {_NAMES[kind]}: {missing} of {reached + missing} cars skipped for want of a gradient ({share:.1f} %)"
        )
    return lines


def _factor_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """The learned constants of each fold."""
    lines = []
    for o in outcomes:
        if o.job.kind != "constant":
            continue
        words = []
        if "factors" in o.parameters:
            words += [
                f"{name} x{math.exp(value):.2f}"
                for name, value in zip(TERMS, o.parameters["factors"].tolist(), strict=True)
            ]
        if "offset_and_gain" in o.parameters:
            words.append("mask logits offset {:+.2f}, gain {:+.2f}".format(*o.parameters["offset_and_gain"].tolist()))
        lines.append(f"- constants of fold {o.job.fold}: " + ", ".join(words))
    return lines


def csv_text(outcomes: Sequence[Outcome], options: Options) -> str:
    """One line for each car."""
    variants = variants_of(outcomes)
    fold_of = folds_of(_frames_of(variants[0]), options.folds, options.training.seed)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    kinds = ("fixed", "constant", "network")
    measures = ("bev_iou", "centre_m", "yaw_deg")
    writer.writerow(
        ["frame_id", "detection_line", "held_out_fold", "depth_m"]
        + [f"{kind}_{measure}" for kind in ("input", *kinds) for measure in measures]
    )
    for cars in zip(*(variant.cars for variant in variants), strict=True):
        first = cars[0]
        errors = [first.before, *(car.after for car in cars)]
        values = [f"{getattr(e, measure):.4f}" for e in errors for measure in measures]
        writer.writerow(
            [first.frame_id, first.detection_line, fold_of[first.frame_id], f"{first.depth_m:.2f}", *values]
        )
    return text.getvalue()


def _frames_of(variant: Variant) -> list[str]:
    return sorted({car.frame_id for car in variant.cars})


def learning_curve_png(outcomes: Sequence[Outcome]) -> bytes:
    """Loss over epochs on training and held-out frames, one line for each fold.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(9, 4, "the learning curves")
    both = figure.subplots(1, 2, sharey=True)
    kinds: tuple[Kind, Kind] = ("constant", "network")
    for axes, kind in zip(both, kinds, strict=True):
        for o in (o for o in outcomes if o.job.kind == kind):
            number = range(1, len(o.epochs) + 1)
            colour = f"C{o.job.fold}"
            axes.plot(number, [e.loss for e in o.epochs], color=colour, label=f"fold {o.job.fold}, training")
            held_out = [(k, e.held_out_loss) for k, e in zip(number, o.epochs, strict=True) if e.held_out_loss >= 0]
            axes.plot(*zip(*held_out, strict=True), "--o", color=colour, label="held out")
        axes.set_title(_NAMES[kind])
        axes.set_xlabel("epoch")
        axes.legend(fontsize="small")
    both[0].set_ylabel("mean loss per car")
    return figure_png(figure)
