"""How good must the start be? Success of the refinement against the error of its start.

Every counted car of a data set with exact masks starts at the truth, moved by a given distance in a random horizontal
direction and turned by a given angle of random sign. The same directions and signs serve every cell of the table.
Success: the centre of the refined box within 0.2 m and its heading within 3 degrees (modulo 360) of the label.

    python scripts/convergence_basin.py --data ROOT --detections LABELS_AS_RESULTS --masks DIR --out DIR
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from command_line import run_command
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.config_files import load_config
from directshape_torch.errors import InputError
from directshape_torch.evaluation.matching import CountedLabels, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.files.atomic_files import write_text
from directshape_torch.geometry.box3d import rotation_about_y
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult

POSITION_ERRORS_M = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5)
YAW_ERRORS_DEG = (2.0, 5.0, 10.0, 15.0, 20.0)
CENTRE_LIMIT_M = 0.2
YAW_LIMIT_DEG = 3.0


@dataclass(frozen=True)
class Trial:
    """One car refined from one start."""

    start_position_m: float
    start_yaw_deg: float
    centre_m: float
    yaw_deg: float

    @property
    def success(self) -> bool:
        return self.centre_m <= CENTRE_LIMIT_M and self.yaw_deg <= YAW_LIMIT_DEG


def perturbed(
    T_cam_obj: Tensor,  # (B, 4, 4) true poses
    direction_rad: Tensor,  # (B,) of the shift, in the horizontal plane of the camera
    sign: Tensor,  # (B,) of the turn, +1 or -1
    position_m: float,
    yaw_deg: float,
) -> Tensor:
    """True poses moved by `position_m` and turned about the car's own vertical axis by `yaw_deg`: (B, 4, 4)."""
    start = T_cam_obj.clone()
    start[:, :3, :3] = T_cam_obj[:, :3, :3] @ rotation_about_y(sign * math.radians(yaw_deg))
    start[:, 0, 3] += position_m * torch.cos(direction_rad)
    start[:, 2, 3] += position_m * torch.sin(direction_rad)
    return start


def trials_of_frame(
    refiner: DirectShapeRefiner, loaded: LoadedFrame, cells: Sequence[tuple[float, float]], seed: int
) -> list[Trial]:
    """Refine the cars of a frame from every start; only counted cars with a left mask are reported.

    Raises:
        InputError: the frame has no labels.
    """
    if loaded.labels is None:
        raise InputError("data", f"labels for frame {loaded.frame_id}", "no label file", "give training/label_2")
    rows = loaded.row_of_detection
    partner = match_to_labels([loaded.input_objects[row] for row in rows], loaded.labels)
    counted = CountedLabels()
    has_mask = loaded.detections.has_mask_left.tolist()
    used = [k for k, p in enumerate(partner) if p >= 0 and has_mask[k] and counted.counts(loaded.labels[p])]
    if not used:
        return []
    true_boxes = boxes_of([loaded.labels[partner[k]] for k in used])
    direction, sign = _random_directions(loaded, seed)
    trials = []
    for position_m, yaw_deg in cells:
        start = perturbed(loaded.detections.T_cam_obj, direction, sign, position_m, yaw_deg)
        result = refiner(loaded.frame, replace(loaded.detections, T_cam_obj=start))
        errors = pose_errors(result_boxes(result)[used], true_boxes)
        trials += [
            Trial(position_m, yaw_deg, float(centre), float(yaw))
            for centre, yaw in zip(errors.centre_m, errors.yaw_deg, strict=True)
        ]
    return trials


def _random_directions(loaded: LoadedFrame, seed: int) -> tuple[Tensor, Tensor]:
    """Direction of the shift and sign of the turn of each car; they depend on the frame, not on what ran before."""
    generator = np.random.default_rng([seed, *loaded.frame_id.encode()])
    count, like = len(loaded.detections), loaded.detections.T_cam_obj
    direction = generator.uniform(0, 2 * math.pi, count)
    sign = generator.choice([-1.0, 1.0], count)
    return torch.from_numpy(direction).to(like), torch.from_numpy(sign).to(like)


def result_boxes(result: RefinementResult) -> Tensor:
    """Boxes (B, 7) of a refinement in the frame of the labels, columns as in `boxes_of`, float64."""
    boxes = result.boxes()
    columns = [boxes.location_ref, boxes.dimensions_hwl, boxes.rotation_y[:, None]]
    return torch.cat(columns, dim=-1).double().cpu()


def success_table(
    trials: Sequence[Trial], positions_m: Sequence[float], yaws_deg: Sequence[float]
) -> NDArray[np.float64]:
    """Share of successes (positions, yaws); NaN where nothing was tried."""
    table = np.full((len(positions_m), len(yaws_deg)), np.nan)
    for i, position in enumerate(positions_m):
        for j, yaw in enumerate(yaws_deg):
            cell = [t.success for t in trials if (t.start_position_m, t.start_yaw_deg) == (position, yaw)]
            if cell:
                table[i, j] = np.mean(cell)
    return table


def markdown_table(
    table: NDArray[np.float64], positions_m: Sequence[float], yaws_deg: Sequence[float], num_cars: int
) -> str:
    """The share of successes in percent, one row for each position error."""
    lines = [
        f"Success (centre within {CENTRE_LIMIT_M} m and yaw within {YAW_LIMIT_DEG} deg), percent of {num_cars} cars:",
        "",
        "| start error | " + " | ".join(f"{yaw:g} deg" for yaw in yaws_deg) + " |",
        "|---" * (len(yaws_deg) + 1) + "|",
    ]
    for position, row in zip(positions_m, table, strict=True):
        lines.append(f"| {position:g} m | " + " | ".join(f"{100 * share:.0f}" for share in row) + " |")
    return "\n".join(lines) + "\n"


# Where the iterations end is asked, not what is made of it.
EVERY_RESULT = "acceptance.min_probability_better=0"


def run(args: argparse.Namespace) -> None:
    """Refine all frames from all starts; print and write the table."""
    refiner = DirectShapeRefiner(config=load_config(args.config, [EVERY_RESULT, *args.set])).to(args.device)
    dataset = KittiStereoDataset(args.data, args.detections, args.masks, frames=args.frames)
    cells = [(position, yaw) for position in args.positions for yaw in args.yaws]
    trials: list[Trial] = []
    for number, frame_id in enumerate(dataset.frame_ids, start=1):
        loaded = dataset.load(frame_id)
        loaded = replace(loaded, frame=loaded.frame.to(args.device), detections=loaded.detections.to(args.device))
        trials += trials_of_frame(refiner, loaded, cells, args.seed)
        print(f"{number}/{len(dataset)} {frame_id}: {sum(t.success for t in trials)}/{len(trials)}", file=sys.stderr)
    table = success_table(trials, args.positions, args.yaws)
    report = markdown_table(table, args.positions, args.yaws, len(trials) // max(1, len(cells)))
    write_text(args.out / "convergence_basin.md", report)
    print(report)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--detections", type=Path, required=True, metavar="DIR", help="the labels as result files")
    parser.add_argument("--masks", type=Path, required=True, metavar="DIR", help="instance masks")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all")
    parser.add_argument("--config", type=Path, metavar="FILE")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--positions", type=float, nargs="+", default=POSITION_ERRORS_M, metavar="M")
    parser.add_argument("--yaws", type=float, nargs="+", default=YAW_ERRORS_DEG, metavar="DEG")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
