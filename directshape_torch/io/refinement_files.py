"""The result of a refinement as the files of each frame: `data/NNNNNN.txt` and `shapes/NNNNNN.npz`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.box3d import alpha_from_kitti
from directshape_torch.io.result_files import RefinedBox, ShapeArrays, write_result_text
from directshape_torch.io.run_folder import result_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.io.track_files import track_name
from directshape_torch.result import RefinementResult


def write_result(
    out_dir: Path | str, loaded: LoadedFrame, result: RefinementResult, prior_sha256: str, first_row: int = 0
) -> ShapeArrays:
    """Write the result file of a frame, and return what belongs into the file of its shapes.

    Args:
        out_dir: the output folder.
        loaded: the frame as it was read.
        result: of a call with this frame's detections, alone or in a batch (`collate`).
        prior_sha256: of the shape prior.
        first_row: where the frame's detections begin in `result`.

    Raises:
        InputError: the result does not cover the frame's detections.
    """
    num_cars = len(loaded.detections)
    if first_row + num_cars > len(result):
        raise InputError("result", f"at least {first_row + num_cars} cars", f"{len(result)}")
    rows = torch.arange(first_row, first_row + num_cars, device=result.T_cam_obj.device)
    shapes = shape_arrays(loaded, result, prior_sha256, rows)
    boxes = refined_boxes(loaded, shapes, result.refined[rows].tolist())
    write_result_text(result_path(out_dir, loaded.frame_id), loaded.input_objects, boxes)
    return shapes


def refined_boxes(loaded: LoadedFrame, shapes: ShapeArrays, refined: Sequence[bool]) -> dict[int, RefinedBox]:
    """The new box of each input line whose car was refined; all others keep their line."""
    location_ref, rotation_y = (
        torch.from_numpy(array).double() for array in (shapes.boxes_location_ref, shapes.boxes_rotation_y)
    )
    alpha = alpha_from_kitti(location_ref, rotation_y).tolist()
    return {
        line: RefinedBox(
            hwl=_triple(shapes.boxes_hwl[car]),
            location_ref=_triple(shapes.boxes_location_ref[car]),
            rotation_y=float(shapes.boxes_rotation_y[car]),
            alpha=alpha[car],
        )
        for car, line in enumerate(loaded.row_of_detection)
        if refined[car]
    }


def shape_arrays(loaded: LoadedFrame, result: RefinementResult, prior_sha256: str, rows: Tensor) -> ShapeArrays:
    """What `shapes/NNNNNN.npz` holds, for the given rows of a result."""
    boxes, words = result.boxes(), result.observability.words()
    statuses = [result.status[row] for row in rows.tolist()]
    lines = [loaded.input_objects[row].line_number for row in loaded.row_of_detection]
    return ShapeArrays(
        frame_id=loaded.frame_id,
        prior_sha256=prior_sha256,
        ground_source=loaded.frame.ground.source[0],
        input_lines=np.array(lines, dtype=np.int64),
        tracks=_tracks(loaded),
        track_parts=_numpy(result.track_part[rows]).astype(np.int64),
        T_cam_obj=_numpy(result.T_cam_obj[rows]),
        T_ref_obj=_numpy(result.T_ref_obj[rows]),
        boxes_hwl=_numpy(boxes.dimensions_hwl[rows]),
        boxes_location_ref=_numpy(boxes.location_ref[rows]),
        boxes_rotation_y=_numpy(boxes.rotation_y[rows]),
        codes=_numpy(result.code[rows]),
        covariances=_numpy(result.covariance[rows]),
        covariances_ref=_numpy(result.covariance_xyz_yaw[rows]),
        statuses=tuple(status.name for status in statuses),
        messages=tuple(status.value for status in statuses),
        term_names=result.term_names,
        costs_before=_numpy(result.cost_before[rows]),
        costs_after=_numpy(result.cost_after[rows]),
        iterations=_numpy(result.iterations[rows]).astype(np.int64),
        has_mask_left=_numpy(loaded.detections.has_mask_left),
        mask_iou_left=_numpy(result.quality.mask_iou_left[rows]),
        mask_iou_right=_numpy(result.quality.mask_iou_right[rows]),
        photometric_errors_grey=_numpy(result.quality.photometric_error_grey[rows]),
        matched_shares=_numpy(result.quality.matched_share[rows]),
        probabilities_better=_numpy(result.quality.probability_better[rows]),
        probabilities_not_worse=_numpy(result.quality.probability_not_worse[rows]),
        sigmas_ref=_numpy(result.sigma_xyz_yaw[rows]),
        unseen=tuple(words[row] for row in rows.tolist()),
        unseen_sigmas_m=_numpy(result.observability.sigmas_m[rows]),
        unseen_directions=_numpy(result.observability.directions[rows]),
        profile_offsets_px=_numpy(result.profile.offsets_px),
        profile_costs_before=_numpy(result.profile.cost_before[rows]),
        profile_costs_after=_numpy(result.profile.cost_after[rows]),
    )


def _tracks(loaded: LoadedFrame) -> tuple[str, ...]:
    ids = loaded.detections.track_id
    if ids is None:
        return ("",) * len(loaded.detections)
    return tuple(track_name(loaded.sequence or "", number) for number in ids.tolist())


def _numpy(tensor: Tensor) -> NDArray[Any]:
    return np.asarray(tensor.detach().cpu().numpy())


def _triple(values: NDArray[Any]) -> tuple[float, float, float]:
    first, second, third = (float(value) for value in values)
    return first, second, third
