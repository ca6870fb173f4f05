"""Shape priors of several encodings side by side: accuracy, smoothness, time, and what they refine on rendered frames.

    R=$DIRECTSHAPE_DATA/rendered
    python scripts/compare_priors.py --prior pca neural FILE ... [--meshes $DIRECTSHAPE_DATA/meshes]
        [--data $R --detections $R/detections/stereo --masks $R/training/masks --out out/priors [--frames ..]]

- fit: the code alone fitted by Gauss-Newton to new parametric cars (seeds that no prior was made of) at the nodes of a
  0.1 m grid within 7 cm of the surface; mean |fitted - true| distance. With --meshes also to the real cars of
  `judge_prior.py`.
- |grad|: norm of the gradient within 5 cm of the zero level of cars with random codes, mean and standard deviation.
- turn: angle between the normals of two points of the zero level 5 cm apart, median and 95th percentile.
- time: value, and value with derivatives, of 10 000 points of one car; processor time on one thread.
- the refinement of the frames in --data, as `directshape refine --prior` and `directshape compare` do it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from build_bundled_prior import GRID, sample_grid
from command_line import run_command
from judge_prior import ordinary_cars, true_sdf
from torch import Tensor
from torch.nn.functional import normalize

from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.config_files import load_config
from directshape_torch.evaluation.comparison import compare_results, lines_with_left_mask
from directshape_torch.evaluation.comparison_summary import GroupSummary
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.prior_quality import NEAR_SURFACE_M
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior

FIRST_NEW_SEED = 10_000
RANDOM_CARS, POINTS_A_CAR = 8, 4000
SURFACE_M, STEP_M = 0.05, 0.05


@dataclass(frozen=True)
class PriorFigures:
    """What one prior is like without any image."""

    fit_cm: float
    fit_meshes_cm: float
    gradient_mean: float
    gradient_std: float
    turn_median_deg: float
    turn_95_deg: float
    value_ms: float
    derivatives_ms: float


def fit_error_cm(prior: ShapePrior, points: Tensor, truth: Tensor, iterations: int = 15) -> float:
    """Mean |fitted - true| distance at points (P, 3) after fitting the code alone, damped, the best step kept."""
    index = torch.zeros(len(points), dtype=torch.long)
    code, best, damping = prior.initial_code(1), torch.inf, 1e-3
    trial, H, g = code, torch.eye(prior.num_codes), torch.zeros(prior.num_codes)
    for _ in range(iterations):
        at = prior.bind(trial).value_and_derivatives(points, index)
        cost = float(((at.value - truth) ** 2).sum())
        if cost < best:
            code, best, damping = trial, cost, 0.2 * damping
            H, g = at.J_value_code.T @ at.J_value_code, at.J_value_code.T @ (at.value - truth)
        else:
            damping *= 10
        trial = code - torch.linalg.solve(H + damping * torch.diag(H.diag()), g)[None]
    return 100 * float((prior.bind(code).value(points, index) - truth).abs().mean())


def mean_fit_cm(prior: ShapePrior, cars: Sequence[Tensor]) -> float:
    """Mean of `fit_error_cm` over signed distance grids (nx, ny, nz); NaN without any."""
    nodes = torch.from_numpy(GRID.nodes()).float()
    near = [car.abs() <= NEAR_SURFACE_M for car in cars]
    errors = [fit_error_cm(prior, nodes[kept], car[kept]) for car, kept in zip(cars, near, strict=True)]
    return sum(errors) / len(errors) if errors else float("nan")


def surface_points(shape: BoundShape, prior: ShapePrior, index: Tensor, generator: torch.Generator) -> Tensor:
    """Points (P, 3) of the zero levels: random ones of the bounds, moved there by Newton's steps along the gradient."""
    lower, upper = prior.bounds_obj
    points = lower + torch.rand(len(index), 3, generator=generator, dtype=lower.dtype) * (upper - lower)
    for _ in range(8):
        at = shape.value_and_derivatives(points, index)
        step = at.value[:, None] * at.gradient / (at.gradient**2).sum(1, keepdim=True).clamp_min(0.1)
        points = torch.minimum(torch.maximum(points - step, lower), upper)
    return points


def turn_deg(shape: BoundShape, prior: ShapePrior, points: Tensor, index: Tensor, generator: torch.Generator) -> Tensor:
    """Angles (Q,) between the normals of points of the zero level that are a step apart."""
    normal = normalize(shape.value_and_derivatives(points, index).gradient, dim=1)
    tangent = torch.randn(points.shape, generator=generator, dtype=points.dtype)
    tangent = normalize(tangent - (tangent * normal).sum(1, keepdim=True) * normal, dim=1)
    there = points + STEP_M * tangent
    for _ in range(4):
        at = shape.value_and_derivatives(there, index)
        there = there - at.value[:, None] * at.gradient / (at.gradient**2).sum(1, keepdim=True).clamp_min(0.1)
    at = shape.value_and_derivatives(there, index)
    cosine = (normal * normalize(at.gradient, dim=1)).sum(1).clamp(-1, 1)
    inside = ((there > prior.bounds_obj[0]) & (there < prior.bounds_obj[1])).all(1)
    kept = inside & (at.value.abs() < 1e-3) & ((there - points).norm(dim=1) < 1.5 * STEP_M)
    return torch.rad2deg(torch.arccos(cosine[kept]))


def best_ms(function: object, *arguments: Tensor, repeats: int = 10) -> float:
    """Least processor time of several calls, milliseconds: what else runs on the machine matters little."""
    assert callable(function)
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function(*arguments)
        times.append(time.process_time() - start)
    return 1000 * min(times)


@torch.no_grad()
def figures(prior: ShapePrior, new_cars: Sequence[Tensor], meshes: Sequence[Tensor]) -> PriorFigures:
    """Measure a prior, float32 on the CPU, against signed distance grids of cars."""
    generator = torch.Generator().manual_seed(0)
    shape = prior.bind(torch.randn(RANDOM_CARS, prior.num_codes, generator=generator))
    index = torch.arange(RANDOM_CARS).repeat_interleave(POINTS_A_CAR)
    surface = surface_points(shape, prior, index, generator)
    near = surface + SURFACE_M * (2 * torch.rand(len(surface), 1, generator=generator) - 1) * normalize(
        shape.value_and_derivatives(surface, index).gradient, dim=1
    )
    at = shape.value_and_derivatives(near, index)
    norms = at.gradient.norm(dim=1)[at.value.abs() < SURFACE_M]
    on_surface = shape.value(surface, index).abs() < 1e-3
    turns = turn_deg(shape, prior, surface[on_surface], index[on_surface], generator)
    one, points = prior.bind(prior.initial_code(1)), near[:10_000]
    zeros = torch.zeros(len(points), dtype=torch.long)
    return PriorFigures(
        fit_cm=mean_fit_cm(prior, new_cars),
        fit_meshes_cm=mean_fit_cm(prior, meshes),
        gradient_mean=float(norms.mean()),
        gradient_std=float(norms.std()),
        turn_median_deg=float(turns.median()),
        turn_95_deg=float(turns.quantile(0.95)),
        value_ms=best_ms(one.value, points, zeros),
        derivatives_ms=best_ms(one.value_and_derivatives, points, zeros),
    )


def refined(prior: ShapePrior, args: argparse.Namespace, out: Path) -> tuple[GroupSummary, float]:
    """Figures over all detections after a refinement with this prior, and milliseconds of processor time a car.

    The time includes reading and writing; it is zero where all frames were there already.
    """
    dataset = KittiStereoDataset(args.data, args.detections, args.masks, frames=args.frames)
    start = time.process_time()
    # The model of trust was fitted to the bundled prior.
    every_result = load_config(None, ["acceptance.min_probability_better=0"])
    summary = refine_dataset(dataset, DirectShapeRefiner(prior, every_result), out)
    spent_s = time.process_time() - start
    comparison = compare_results(
        args.data / "training" / "label_2",
        args.detections,
        out / "data",
        frames=dataset.frame_ids,
        keep_line=lines_with_left_mask(out / "shapes"),
    )
    num_cars = summary.timings.num_cars
    return comparison.overall, 1000 * spent_s / num_cars if num_cars else 0.0


def table_of_figures(rows: Sequence[tuple[str, PriorFigures]]) -> str:
    """Markdown."""
    columns = "prior", "fit: new cars", "real meshes", "gradient", "turn: median, 95 %", "value", "derivatives"
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for name, f in rows:
        cells = (
            name,
            f"{f.fit_cm:.2f} cm",
            f"{f.fit_meshes_cm:.2f} cm",
            f"{f.gradient_mean:.3f} +- {f.gradient_std:.3f}",
            f"{f.turn_median_deg:.2f}, {f.turn_95_deg:.1f} deg",
            f"{f.value_ms:.1f} ms",
            f"{f.derivatives_ms:.1f} ms",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def table_of_refinements(rows: Sequence[tuple[str, GroupSummary, float]]) -> str:
    """Markdown; the first row is the input."""
    keys = ("bev_iou_mean", "iou_3d_mean", "bev_iou_good_share", "centre_m_median", "yaw_deg_median")
    lines = [
        "| prior | BEV IoU, mean | 3D IoU, mean | BEV IoU > 0.7 | centre, median | yaw, median | worse | per car |",
        "|---|---|---|---|---|---|---|---|",
    ]
    before = {key: rows[0][1].metrics[key].before for key in keys}
    for name, estimates, worse, per_car in [
        ("input", before, "", ""),
        *(
            (
                name,
                {key: group.metrics[key].after for key in keys},
                "" if group.worse_share is None else f"{100 * group.worse_share.value:.1f} %",
                f"{ms:.0f} ms" if ms else "",
            )
            for name, group, ms in rows
        ),
    ]:
        bev, iou_3d, good, centre, yaw = (estimates[key] for key in keys)
        lines.append(
            f"| {name} | {bev.value:.3f} [{bev.low:.3f}, {bev.high:.3f}] | {iou_3d.value:.3f} "
            f"| {100 * good.value:.1f} % | {centre.value:.3f} m | {yaw.value:.2f} deg | {worse} | {per_car} |"
        )
    return "\n".join(lines)


def run(args: argparse.Namespace) -> None:
    """Measure every prior and print the tables."""
    torch.set_num_threads(args.threads)
    priors = {Path(source).stem: load_prior(source) for source in args.prior}
    new_cars = [torch.from_numpy(sample_grid(FIRST_NEW_SEED + k)) for k in range(args.new_cars)]
    files = {} if args.meshes is None else ordinary_cars(args.meshes)
    meshes = [torch.from_numpy(true_sdf(file, GRID)) for file in files.values()]
    rows = []
    for name, prior in priors.items():
        rows.append((name, figures(prior, new_cars, meshes)))
        print(rows[-1], file=sys.stderr)
    print(table_of_figures(rows))
    if args.data is not None:
        refinements = []
        for name, prior in priors.items():
            refinements.append((name, *refined(prior, args, args.out / name)))
            print(f"{name}: refined", file=sys.stderr)
        print()
        print(table_of_refinements(refinements))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", nargs="+", default=["pca", "neural"], metavar="FILE|NAME")
    parser.add_argument("--new-cars", type=int, default=20)
    parser.add_argument("--meshes", type=Path, metavar="DIR", help="folder of real car meshes")
    parser.add_argument("--data", type=Path, metavar="ROOT", help="folder that holds training/; none: no refinement")
    parser.add_argument("--detections", type=Path, metavar="DIR")
    parser.add_argument("--masks", type=Path, metavar="DIR")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all")
    parser.add_argument("--out", type=Path, default=Path("out/priors"), metavar="DIR")
    parser.add_argument("--threads", type=int, default=1)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
