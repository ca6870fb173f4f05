"""This script refines cars whose boxes are wrong by a quarter or half turn or by 3 m, with and without `search`.

    R=$DIRECTSHAPE_DATA/rendered
    python scripts/wrong_boxes.py --data $R --detections $R/detections/stereo --masks $R/training/masks

All boxes are changed alike, and their 2D boxes and masks stay. The refiner has no rig, so it takes the detector to be
as most detectors are, which a run whose boxes are all wrong would not. Printed are, for each way to be wrong and each
value of `search`, the mean BEV IoU before and after, the share of cars whose BEV IoU fell by more than 0.05, and the
share of axes that are off by more than 60 degrees at the end, of all counted labels with a mask, and how many cars were
found from their mask. A second table says how many masks stand out from their surroundings, as a search demands, on
their own image and on the next one of the same size.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from command_line import run_command
from torch import Tensor

from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.geometry.box3d import rotation_about_y
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.refinement.lost_cars import LARGEST_SHARE_GOING_ON
from directshape_torch.refinement.trust import WORSE_BY
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.start.mask_border import share_going_on
from directshape_torch.status import Status
from directshape_torch.stereo_matching.disparity import with_disparity


def turned(degrees: float) -> Callable[[Tensor], Tensor]:
    """A change of poses (B, 4, 4) that turns each car about its own upright axis."""

    def change(T_cam_obj: Tensor) -> Tensor:
        T = T_cam_obj.clone()
        T[:, :3, :3] = T[:, :3, :3] @ rotation_about_y(T.new_tensor(math.radians(degrees)))
        return T

    return change


def farther(metres: float) -> Callable[[Tensor], Tensor]:
    """A change of poses (B, 4, 4) that moves each car along its viewing ray on the ground."""

    def change(T_cam_obj: Tensor) -> Tensor:
        T = T_cam_obj.clone()
        T[:, 0:3:2, 3] *= 1 + metres / T[:, 0:3:2, 3].norm(dim=1, keepdim=True)
        return T

    return change


WRONG = {
    "turned by 90 degrees": turned(90.0),
    "3 m too far": farther(3.0),
    "3 m too near": farther(-3.0),
    "turned by 180 degrees": turned(180.0),
    "as they are": turned(0.0),
}


def run(args: argparse.Namespace) -> None:
    """Refine and print the table."""
    dataset = open_dataset("kitti", args.data, args.detections, args.masks)
    config = load_config(None, ["check=off"])
    loaded = [dataset.load(frame_id) for frame_id in dataset.frame_ids]
    print("| boxes | search | cars | BEV IoU, mean (worse) | axis off by more than 60 degrees | found from the mask |")
    print("|---|---|---|---|---|---|")
    for name, change in WRONG.items():
        for search in args.search:
            refiner = DirectShapeRefiner(config=replace(config, search=search))
            parts = [refined(refiner, frame, change) for frame in loaded if len(frame.detections)]
            before, after, off_deg, found = torch.cat(parts).unbind(dim=1)
            means, worse = f"{before.mean():.3f} -> {after.mean():.3f}", (after < before - WORSE_BY).double().mean()
            ends = f"{(off_deg > 60).double().mean():.1%} | {int(found.sum())}"
            print(
                f"| {name} | {search} | {len(before)} | {means} ({worse:.1%}) | {ends} |",
                flush=True,
            )

    print(f"\n{masks_that_stand_out(loaded)}")


def masks_that_stand_out(loaded: Sequence[LoadedFrame]) -> str:
    """A table of the masks that stand out on their own images, and laid on the next image of the same size."""
    frames = [with_disparity(each.frame) for each in loaded]
    lines = ["| masks of at least 400 pixels on | stand out | least share that goes on |", "|---|---|---|"]
    for name, offset in (("their own image", 0), ("the next image", 1)):
        shares = []
        for number, each in enumerate(loaded):
            masks, disparity = each.detections.mask_left, frames[(number + offset) % len(frames)].disparity
            if disparity is not None and tuple(disparity.shape[1:]) == masks.size_hw:
                share = share_going_on(disparity, masks, each.detections.frame_index)
                shares.append(share[(masks.areas >= 400) & share.isfinite()])
        share = torch.cat(shares)
        lines.append(f"| {name} | {int((share < LARGEST_SHARE_GOING_ON).sum())} of {len(share)} | {share.min():.2f} |")
    return "\n".join(lines)


@torch.no_grad()
def refined(refiner: DirectShapeRefiner, loaded: LoadedFrame, change: Callable[[Tensor], Tensor]) -> Tensor:
    """BEV IoU before and after, degrees off the axis, and whether it was found from its mask, of N cars (N, 4)."""
    detections = replace(loaded.detections, T_cam_obj=change(loaded.detections.T_cam_obj))
    result = refiner(loaded.frame, detections)
    labels = match_to_labels(loaded.detected_objects, loaded.labels or [])
    has_mask = detections.has_mask_left.tolist()
    rows = [row for row, label in labels.items() if is_counted(label) and has_mask[row]]
    truth = boxes_of([labels[row] for row in rows]).reshape(-1, 7)
    given = poses_to_boxes(detections.T_cam_obj, detections.dimensions_hwl, "kitti", None)
    given = torch.cat([given[:, :3] - result.t_cam_ref, given[:, 3:]], dim=1)
    after = result.to_boxes("kitti", "ref")
    overlaps = [pose_errors(boxes[rows].double(), truth).bev_iou for boxes in (given, after)]
    off_deg = torch.rad2deg(torch.asin(torch.sin(after[rows, 6].double() - truth[:, 6]).abs()))
    found = torch.tensor([result.status[row] is Status.rescued for row in rows], dtype=torch.float64)
    return torch.stack([*overlaps, off_deg, found], dim=1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("--data", "--detections", "--masks"):
        parser.add_argument(name, type=Path, required=True, metavar="DIR", help="as of directshape refine")
    parser.add_argument("--search", nargs="+", default=["off", "rescue"], help="values of the setting")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
