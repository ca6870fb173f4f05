"""Proof of the rig's estimate: right images bent by known smooth fields, and what detections alone say of them.

    R=$DIRECTSHAPE_DATA/rendered
    python scripts/warp_rig.py --data $R --exact $R/detections/gt --fields-px 0.3 0.6 1 1.5

Detections are drawn round the exact ones, the rig is estimated from them, and its field is compared at the cars with
the true one: errors in pixels and in the standard deviations that the estimate states. A field is a polynomial of
fourth degree over the right image, as lenses bend it, of which `--fields-px` are the largest values; rows are bent by
`--rows-px`. The same seed bends in the same way.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from command_line import run_command
from quality_calibration.bend import Bend
from quality_calibration.noise import LEVELS, NoiseLevel, noisy
from torch import Tensor

from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.rig.detections import COLUMNS, observe_detections
from directshape_torch.rig.estimate import RigEstimate


def draw(args: argparse.Namespace) -> None:
    """Print the errors of estimates from drawn detections."""
    torch.set_num_threads(args.threads)
    dataset = KittiStereoDataset(args.data, args.exact, args.data / "training" / "masks")
    size_wh = _size_wh(args.data / "training" / "image_3")
    print(
        "| field, px | detector | draws | error, rms px | stated, px | in sigmas, rms | within 2 sigma | noise found |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for level in [level for level in LEVELS if level.name in args.levels]:
        everything: list[Tensor] = []
        for k, largest_px in enumerate(args.fields_px):
            bend = Bend.drawn(largest_px, args.rows_px, size_wh, args.seed + k)
            found = _errors(dataset, bend, level, args.draws, args.frames_per_draw)
            print(_line(f"{largest_px:g}", level, args.draws, found), flush=True)
            everything.append(found)
        print(_line("all", level, args.draws * len(everything), torch.cat(everything)), flush=True)


def _errors(
    dataset: KittiStereoDataset, bend: Bend, level: NoiseLevel, num_draws: int, frames_per_draw: int
) -> Tensor:  # (N, 3)
    """Error and standard deviation at the cars of all draws, pixels, and the noise that the draw found."""
    found = []
    rng = np.random.default_rng(0)
    for number in range(num_draws):
        chosen = rng.choice(len(dataset.frame_ids), min(frames_per_draw, len(dataset.frame_ids)), replace=False)
        rig: RigEstimate | None = None
        for index in sorted(chosen.tolist()):
            loaded = dataset.load(dataset.frame_ids[index])
            frames = bend.frames(loaded.frame)
            rig = RigEstimate.of_frames(frames) if rig is None else rig
            detections = noisy(loaded.detections, level, 1000 * number + index)
            rig.add_rows(observe_detections(frames, detections))
        assert rig is not None
        column = dict(zip(COLUMNS, rig.rows.unbind(dim=1), strict=True))
        uv = torch.stack([column["u"], column["v"]], dim=1)
        mean, sigma = rig.offset_at(uv)
        true = bend.offset(torch.stack([column["u"] - column["disparity"], column["v"]], dim=1))
        found.append(torch.stack([mean - true, sigma, torch.full_like(sigma, rig.detector.noise)], dim=1))
        print(f"draw {number + 1} of {num_draws}", end="\r", file=sys.stderr, flush=True)
    return torch.cat(found)


def _line(field: str, level: NoiseLevel, num_draws: int, found: Tensor) -> str:
    error, sigma, noise = found.unbind(dim=1)
    in_sigmas = error / sigma
    return (
        f"| {field} | {level.name} ({level.depth_share:.1%}) | {num_draws} | {error.square().mean().sqrt():.3f} | "
        f"{sigma.square().mean().sqrt():.3f} | {in_sigmas.square().mean().sqrt():.2f} | "
        f"{(in_sigmas.abs() < 2).double().mean():.0%} | {noise.mean():.1%} |"
    )


def _size_wh(folder: Path) -> tuple[int, int]:
    height, width = read_rgb(min(folder.glob("*.png"))).shape[:2]
    return width, height


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--rows-px", type=float, default=0.3, help="largest error of the rows (default 0.3)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exact", type=Path, required=True, metavar="DIR", help="labels as result files")
    parser.add_argument("--fields-px", type=float, nargs="+", default=[0.3, 0.6, 1.0, 1.5], metavar="PX")
    names = [level.name for level in LEVELS]
    parser.add_argument("--levels", nargs="+", choices=names, default=names, help="noise of the detector")
    parser.add_argument("--draws", type=int, default=9, help="for each field and detector (default 9)")
    parser.add_argument("--frames-per-draw", type=int, default=12)
    parser.add_argument("--threads", type=int, default=1)
    return run_command(parser, draw, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
