"""How far the same cars end apart when nothing that matters has changed.

Refines the frames of a data set one by one, eight in a call, from boxes moved by a millionth of their place and, on
request, with rays marched at every state, the same from boxes moved by a thousandth, and compiled; compares the boxes
with those of the frames one by one. With `--long` once more with 80 iterations in the last stage, which tells a rule
that stops too early (the differences vanish) from flat minima (they stay).

    python scripts/same_answer.py --long --marched --data KITTI --detections DETECTIONS --masks MASKS
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from command_line import run_command
from torch import Tensor

from directshape_torch import DirectShapeRefiner, load_config
from directshape_torch.cli.options import frame_id_of
from directshape_torch.evaluation.tables import align
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.stereo_dataset import LoadedFrame

EIGHT = 8
MILLIONTH, THOUSANDTH = 1e-6, 1e-3
LONG = (
    "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 6, over_relaxation: 1.6}, "
    "{contour_width_px: 0.5, image_level: 0, max_iterations: 80, over_relaxation: 1.6}]"
)


@dataclass(frozen=True)
class Cars:
    """Where the cars of all frames ended."""

    centre: Tensor  # (B, 3) metres
    status: Tensor  # (B,)

    def apart(self, other: Cars) -> tuple[float, float, float, int, int]:
        """Median and largest distance, mm; share of cars over 1 cm apart; cars of another status; cars."""
        distance = 1000 * (self.centre - other.centre).norm(dim=1)
        flips = int((self.status != other.status).sum())
        share = float((distance > 10).double().mean())
        return float(distance.median()), float(distance.max()), share, flips, len(distance)


def refined(frames: Sequence[LoadedFrame], settings: Sequence[str], at_once: int = 1, by: float = 0.0) -> Cars:
    """All cars of some frames, `at_once` of them in a call, from boxes moved by the share `by` of their place."""
    refiner = DirectShapeRefiner(config=load_config("default", settings))
    centres, statuses = [], []
    for first in range(0, len(frames), at_once):
        batch, detections = collate(frames[first : first + at_once])
        T_cam_obj = detections.T_cam_obj.clone()
        T_cam_obj[:, :3, 3] *= 1 + by
        with torch.no_grad():
            result = refiner(batch, replace(detections, T_cam_obj=T_cam_obj))
        centres.append(result.T_cam_obj[:, :3, 3].double())
        statuses.append(result.status_code)
    return Cars(torch.cat(centres), torch.cat(statuses))


def run(args: argparse.Namespace) -> None:
    """Refine, compare, print.

    Raises:
        DirectShapeError: the data cannot be read.
    """
    dataset = KittiStereoDataset(args.data, args.detections, args.masks, frames=args.frames)
    names = dataset.frame_ids[: args.most]
    frames = [loaded for loaded in (dataset.load(name) for name in names) if len(loaded.detections)]
    torch.set_num_threads(1)
    rows = []
    for length in ("as shipped", "80 iterations") if args.long else ("as shipped",):
        settings = ["compile=off", *([LONG, "solver.cost_tolerance=0"] if length != "as shipped" else [])]
        one = refined(frames, settings)
        others = {
            "8 frames in a call": refined(frames, settings, EIGHT),
            "moved by 1e-6": refined(frames, settings, 1, MILLIONTH),
        }
        if args.marched:
            marched = [*settings, "solver.rays=marched"]
            others["rays marched"] = at_rest = refined(frames, marched)
            moved = refined(frames, marched, 1, THOUSANDTH)
        if args.compiled:
            others["compiled"] = refined(frames, [*settings, "compile=on"])
        pairs = {name: (one, other) for name, other in others.items()}
        if args.marched:
            pairs["marched, against those moved by 1e-3"] = at_rest, moved
        for name, (mine, other) in pairs.items():
            median, largest, share, flips, count = mine.apart(other)
            rows.append(
                (length, name, f"{median:.2f}", f"{largest:.0f}", f"{100 * share:.1f} %", str(flips), str(count))
            )
    header = ("iterations", "against one frame in a call", "median, mm", "largest, mm", "over 1 cm", "statuses", "cars")
    print(align([header, *rows]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "detections", "masks"):
        parser.add_argument(f"--{name}", type=Path, required=True, metavar="DIR")
    parser.add_argument("--frames", nargs="+", metavar="ID", type=frame_id_of, help="default all")
    parser.add_argument("--most", type=int, metavar="N", help="frames at most")
    parser.add_argument("--long", action="store_true", help="with 80 iterations too")
    parser.add_argument("--marched", action="store_true", help="against marched rays too, and these from moved boxes")
    parser.add_argument("--compiled", action="store_true", help="against compiled code too")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
