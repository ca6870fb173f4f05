"""Dense alignment of boxes (Li, Chen, Shen, Stereo R-CNN, CVPR 2019), a baseline: only photometry sets the depth.

    R=$DIRECTSHAPE_DATA/rendered
    python scripts/align_boxes.py --data $R --detections $R/detections/stereo --masks $R/training/masks --out out/boxes

The lower half of the box's near sides stands for the car's surface, because box and surface are nearest to each other
there. All pixels of this half are moved in depth by an equal number of metres, to where the images agree best. The
search covers a wide range of disparities first and a narrow one afterwards. Dimensions and heading stay the detector's.
Stereo R-CNN differs in two points: this script takes the pixels of the instance mask, and the norm of the photometric
term. Results are KITTI result files in OUT/data; boxes that cannot be aligned keep their line.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from command_line import run_command
from torch import Tensor

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, load_config
from directshape_torch.batch.frame_outputs import refined_boxes
from directshape_torch.cli.options import add_data_options, dataset_of
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose
from directshape_torch.io.result_files import write_result_text
from directshape_torch.io.run_folder import result_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.tables import Chosen, take_rows
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.observation.packing import pack_pixels
from directshape_torch.observation.refinable import refusals
from directshape_torch.refinement.disparity_profile import profile_figures, profile_offsets, shifted_costs
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.result import KittiBoxes
from directshape_torch.rows import CarSums, ObjectRays, Rays
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.terms.depth import Hits
from directshape_torch.terms.photometric import Photometric, Surface

# The problem has the photometric term alone.
SETTINGS = load_config(
    None,
    [
        "silhouette.weight=0",
        "rig.disparity_sigma_px=0",
        *(f"priors.{name}_weight=0" for name in ("shape", "height", "tilt", "dimensions", "pose")),
    ],
)
# These are the range and the step of each search. The wide search runs twice, because near cars may begin further away
# than one search reaches.
_ROUNDS_PX = ((3.0, 0.25), (3.0, 0.25), (0.5, 0.05))
# These are the lower and the upper corner of a box, and the top of its lower half, in units of length, height and
# width.
_UNIT_BOX = (-0.5, -1.0, -0.5, 0.5, 0.0, 0.5)
_TOP = -0.5


class Aligned(NamedTuple):
    """This is where B boxes are after the alignment."""

    T_cam_obj: Tensor  # (B, 4, 4) the input where a box was not aligned
    is_aligned: Tensor  # (B,) bool, whether the cost has a valley in the last range


@torch.no_grad()
@full_precision()
def aligned(refiner: DirectShapeRefiner, frames: FrameBatch, detections: Detections) -> Aligned:
    """Move boxes along the viewing rays of their origins to the lowest photometric cost."""
    cars = CarBatch.from_scene(frames, detections)
    usable = Chosen.where(refusals(cars, pack_pixels(frames, detections, SETTINGS.sampling), SETTINGS) < 0)
    nothing, rows = Aligned(detections.T_cam_obj, torch.zeros_like(usable.keep)), usable.index
    if not len(rows):
        return nothing
    everyone, inputs = refiner.problem(frames, detections)
    cars = cars.of(usable)
    problem, state = everyone.of(usable), take_rows(inputs, rows)
    for range_px, step_px in _ROUNDS_PX:
        term, surface = _begun(problem, state, cars)
        offsets = profile_offsets(range_px, step_px).to(state.code.device)
        moved_m = torch.stack([_depth(move_by_disparity(state, cars.focal_baseline, x)) for x in offsets.tolist()])
        costs = moved_costs(term, surface, moved_m - _depth(state))
        found = profile_figures(offsets, costs, term.pixel_set.support)
        state = move_by_disparity(state, cars.focal_baseline, found.offset_px.nan_to_num(0.0).to(state.code))
    converged = found.sigma_px.isfinite() & costs.isfinite().all(dim=1) & cars.detector_hwl.isfinite().all(dim=1)
    chosen = rows[converged]
    T_cam_obj = nothing.T_cam_obj.index_copy(0, chosen, se3.inverse(state.T_obj_cam)[converged])
    return Aligned(T_cam_obj, nothing.is_aligned.index_fill(0, chosen, True))


def move_by_disparity(state: CarState, focal_baseline: Tensor, offset_px: float | Tensor) -> CarState:
    """Cars moved along the viewing ray of their origin so that its disparity grows by `offset_px`, (B,) or a number."""
    T_cam_obj = se3.inverse(state.T_obj_cam)
    origin = T_cam_obj[:, :3, 3]
    disparity = focal_baseline / origin[:, 2]
    scale = disparity / (disparity + offset_px).clamp_min(0.1)
    moved = se3.from_rotation_translation(T_cam_obj[:, :3, :3], origin * scale[:, None])
    return state._replace(T_obj_cam=se3.inverse(moved))


def box_hits(
    rays: Rays,
    T_obj_cam: Tensor,  # (B, 4, 4)
    dimensions_hwl: Tensor,  # (B, 3) metres
) -> Hits:
    """The points where rays enter the boxes of their cars; only points on the lower halves are marked as found."""
    in_objects = rays.in_objects(T_obj_cam)
    size = dimensions_hwl.roll(1, dims=1)[rays.owner].mT[..., None]  # (3, M, 1) length, height, width
    in_unit_box = ObjectRays(*(x / size for x in in_objects))
    inside = in_unit_box.interval(constant_like(_UNIT_BOX, size).view(2, 3))
    normal = torch.where(inside.enters == inside.near, -in_objects.direction_obj.sign(), 0.0)
    found = inside.hit & (in_unit_box.at(inside.near)[1] > _TOP)
    return Hits(in_objects.at(inside.near), normal, found, inside.near)


def moved_costs(
    term: Photometric,
    surface: Surface,
    moved_m: Tensor,  # (S, B)
) -> Tensor:
    """Costs (B, S), float64, of B cars when the depths of all their pixels are changed by each of S amounts."""
    rows, owner = term.pixel_set.rows, term.blocks.owner
    sums, no_shift = CarSums.of(owner, len(term.cars)), torch.zeros_like(rows.rays.centre_cam[:, 0])
    everything = torch.ones_like(rows.pixel_weight)[None]

    def cost(metres: Tensor) -> Tensor:
        depth, on_surface = (surface.depth + metres[owner, None])[None], surface.on_surface[None]
        costs = shifted_costs(rows, term.config, everything, depth, on_surface, no_shift, metres.new_zeros(1))
        return sums.sum(costs[0, 0, 0])

    return torch.stack([cost(metres) for metres in moved_m], dim=1)


def _begun(problem: CarProblem, state: CarState, cars: CarBatch) -> tuple[Photometric, Surface]:
    """The photometric term with the pixels of the near sides, and the surface of these sides."""
    hits = box_hits(problem.masks.of_sides[0], state.T_obj_cam, cars.detector_hwl)
    prepared = problem.prepare(state)._replace(hits=hits)
    term = problem.begin(-1, prepared).photometric
    assert term is not None, "the settings give this term a weight"
    return term, term.anchor(prepared)


def _depth(state: CarState) -> Tensor:
    """Depth (B,) of the object origins in the left camera, metres."""
    return se3.inverse(state.T_obj_cam)[:, 2, 3]


def write_boxes(out_dir: Path, loaded: LoadedFrame, found: Aligned) -> None:
    """Write the result file of a frame."""
    detections = loaded.detections
    location = found.T_cam_obj[:, :3, 3] - loaded.frame.camera.t_cam_ref[detections.frame_index]
    rotation_y = rotation_y_from_pose(found.T_cam_obj)
    alpha = alpha_from_kitti(location, rotation_y)
    boxes = KittiBoxes(detections.dimensions_hwl, location, rotation_y, alpha)
    lines = refined_boxes(boxes, found.is_aligned, loaded.row_of_detection)
    write_result_text(result_path(out_dir, loaded.frame_id), loaded.input_objects, lines)


def run(args: argparse.Namespace) -> None:
    """Align the boxes of all frames."""
    if args.rig == "auto":
        cure = "give the rig.json of a run of 'directshape refine', which estimates it, or none"
        raise InputError("--rig", "a file or none", "auto", cure)
    dataset, refiner = dataset_of(args), DirectShapeRefiner(config=SETTINGS)
    num_boxes = num_aligned = 0
    for frame_id in dataset.frame_ids:
        loaded = dataset.load(frame_id)
        found = aligned(refiner, loaded.frame, loaded.detections)
        write_boxes(args.out, loaded, found)
        num_boxes += len(found.is_aligned)
        num_aligned += int(found.is_aligned.sum())
    print(f"{num_aligned} of {num_boxes} boxes aligned, in {args.out}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_data_options(parser, with_disparity=False)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets data/NNNNNN.txt")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
