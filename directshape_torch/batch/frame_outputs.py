"""This module writes all files of one refined frame; the last file contains the hashes of the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.batch.options import RefineOptions
from directshape_torch.files.atomic_files import write_png, write_text
from directshape_torch.geometry.box3d import alpha_from_kitti
from directshape_torch.io.result_files import (
    RefinedBox,
    ShapeArrays,
    track_name,
    write_result_text,
    write_shapes,
)
from directshape_torch.io.run_folder import (
    FrameEntry,
    FrameRecord,
    failure_path,
    frame_entry,
    overlay_path,
    result_path,
    shapes_path,
)
from directshape_torch.io.run_manifest import hash_bytes
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refinement.result import KittiBoxes, RefinementResult
from directshape_torch.status import Status


def write_frame_outputs(
    out_dir: Path,
    loaded: LoadedFrame,
    result: RefinementResult,
    run: str,
    prior_sha256: str,
    inputs: Mapping[str, str],
    options: RefineOptions,
) -> FrameEntry:
    """Write the files that the options ask for; shapes come last, so that their existence marks a complete frame.

    `run`, `prior_sha256` and `inputs` are hashes of the manifest, of the shape prior and of the frame's input files.
    The result is the frame's entry.
    """
    files = [result_path(out_dir, loaded.frame_id)]
    if options.draw is not None:
        files.append(overlay_path(out_dir, loaded.frame_id))
        write_png(files[-1], options.draw(loaded, result))
    boxes = result.boxes()
    shapes = _shape_arrays(loaded, result, boxes, prior_sha256)
    write_result_text(files[0], loaded.input_objects, refined_boxes(boxes, result.refined, loaded.row_of_detection))
    hashes = {file.relative_to(out_dir).as_posix(): hash_bytes(file.read_bytes()) for file in files}
    masks_right = int(loaded.detections.has_mask_right.sum())
    record = FrameRecord(run, inputs, sorted(options.outputs), hashes, len(loaded.input_objects), masks_right)
    write_shapes(shapes_path(out_dir, loaded.frame_id), replace(shapes, made_of=record.text()))
    return frame_entry(shapes, record)


def refined_boxes(boxes: KittiBoxes, refined: Tensor, rows: Sequence[int]) -> dict[int, RefinedBox]:
    """The new box of each refined car, by its input row; rows without a box keep their line."""
    hwl, location, yaw = (each.double().cpu() for each in (boxes.dimensions_hwl, boxes.location_ref, boxes.rotation_y))
    columns = torch.cat([alpha_from_kitti(location, yaw)[:, None], hwl, location, yaw[:, None]], dim=1).tolist()
    return {row: columns[car] for car, row in enumerate(rows) if refined[car]}


def _shape_arrays(loaded: LoadedFrame, result: RefinementResult, boxes: KittiBoxes, prior_sha256: str) -> ShapeArrays:
    """The content of `shapes/NNNNNN.npz` without its record."""
    lines = [loaded.input_objects[row].line_number for row in loaded.row_of_detection]
    return ShapeArrays(
        frame_id=loaded.frame_id,
        prior_sha256=prior_sha256,
        ground_source=loaded.frame.ground.source[0],
        input_lines=np.array(lines, dtype=np.int64),
        tracks=_tracks(loaded),
        track_parts=_numpy(result.track_part).astype(np.int64),
        T_cam_obj=_numpy(result.T_cam_obj),
        T_ref_obj=_numpy(result.T_ref_obj),
        boxes_hwl=_numpy(boxes.dimensions_hwl),
        boxes_location_ref=_numpy(boxes.location_ref),
        boxes_rotation_y=_numpy(boxes.rotation_y),
        codes=_numpy(result.code),
        covariances=_numpy(result.covariance),
        covariances_ref=_numpy(result.covariance_xyz_yaw),
        statuses=tuple(status.name for status in result.status),
        messages=_messages(loaded, result),
        term_names=result.term_names,
        costs_before=_numpy(result.cost_before),
        costs_after=_numpy(result.cost_after),
        iterations=_numpy(result.iterations).astype(np.int64),
        has_mask_left=_numpy(loaded.detections.has_mask_left),
        mask_iou_left=_numpy(result.quality.mask_iou_left),
        mask_iou_right=_numpy(result.quality.mask_iou_right),
        photometric_errors_grey=_numpy(result.quality.photometric_error_grey),
        matched_shares=_numpy(result.quality.matched_share),
        probabilities_better=_numpy(result.quality.probability_better),
        probabilities_not_worse=_numpy(result.quality.probability_not_worse),
        probabilities_heading=_numpy(result.quality.probability_heading),
        distances_in_sigmas=_numpy(result.comparison.distance_in_sigmas),
        sigmas_ref=_numpy(result.sigma_xyz_yaw),
        unseen=tuple(result.observability.words()),
        unseen_sigmas_m=_numpy(result.observability.sigmas_m),
        unseen_directions=_numpy(result.observability.directions),
        profile_offsets_px=_numpy(result.profile.offsets_px),
        profile_costs_before=_numpy(result.profile.cost_before),
        profile_costs_after=_numpy(result.profile.cost_after),
    )


def _messages(loaded: LoadedFrame, result: RefinementResult) -> tuple[str, ...]:
    """The status text of each car, or the reason why it has no mask."""
    reasons = loaded.no_mask_reasons or ("",) * len(result)
    return tuple(
        reason if reason and status is Status.no_mask else status.value
        for status, reason in zip(result.status, reasons, strict=True)
    )


def _tracks(loaded: LoadedFrame) -> tuple[str, ...]:
    ids = loaded.detections.track_id
    if ids is None:
        return ("",) * len(loaded.detections)
    return tuple(track_name(loaded.sequence or "", number) for number in ids.tolist())


def _numpy(tensor: Tensor) -> NDArray[Any]:
    return np.asarray(tensor.detach().cpu().numpy())


def write_failure(out_dir: Path, frame_id: str, reason: str) -> FrameEntry:
    """Write why a frame could not be refined, and return its entry."""
    write_text(failure_path(out_dir, frame_id), reason + "\n")
    return {"reason": reason}
