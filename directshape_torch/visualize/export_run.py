"""`export_run` writes a finished run in the formats of other programs; KITTI's boxes as text and JSON are made here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import check_folder, json_values, write_bytes, write_json
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult, result_path
from directshape_torch.visualize.rerun_recording import recording
from directshape_torch.visualize.run_frames import RunFrame, RunInputs
from directshape_torch.visualize.surface_files import write_glb, write_ply

_KITTI_FRAME = "ref: KITTI's rectified camera 0, x right, y down, z forward, metres and radians"


def write_kitti(folder: Path, frame: RunFrame) -> None:
    """Copy the result lines of a frame unchanged, and write them as `kitti/json/NNNNNN.json`."""
    frame_id, lines = frame.frame_id, read_bytes(result_path(frame.inputs.run.path, frame.frame_id))
    write_bytes(folder / "kitti" / "data" / f"{frame_id}.txt", lines)
    content = {
        "schema": "directshape kitti results",
        "schema_version": 1,
        "frame_id": frame_id,
        "coordinates": _KITTI_FRAME,
        "objects": [{**_columns(line), **_refinement(frame.result, line)} for line in frame.result.lines],
    }
    write_json(folder / "kitti" / "json" / f"{frame_id}.json", content)


_WRITERS: dict[str, Callable[[Path, RunFrame], None]] = {"glb": write_glb, "ply": write_ply, "kitti": write_kitti}
FORMATS = (*_WRITERS, "rerun")
"""These are the formats of `export_run` (docs/outputs.md)."""


def export_run(
    inputs: RunInputs,
    folder: Path | str,
    formats: Sequence[str],
    tell: Callable[[str], object] = lambda _: None,
) -> None:
    """Write the finished frames of a run in other formats (docs/outputs.md). The run itself is only read.

    Args:
        inputs: chosen frames of an output folder, shape prior, and the images for colours.
        folder: folder of `glb`, `ply`, `kitti` and `recording.rrd`; existing files with the same names are replaced.
        formats: names out of `FORMATS`.
        tell: function that is called after each frame.

    Raises:
        MissingDependencyError: "rerun" is chosen without Rerun.
        InputError: a format is unknown, or needs images which were not given.
        DataFormatError: a file of the run or of the data set is missing, damaged or not that of the run.
    """
    run = inputs.run
    check_folder("out", Path(folder))
    if not run.frame_ids:
        raise InputError("frames", f"finished frames of {run.path}", "none")
    if unknown := [name for name in formats if name not in FORMATS]:
        raise InputError("formats", f"of {', '.join(FORMATS)}", repr(unknown[0]))
    folder, wanted = Path(folder), dict.fromkeys(formats)
    writers: list[Callable[[RunFrame], object]] = [
        partial(_WRITERS[name], folder) for name in wanted if name in _WRITERS
    ]
    with ExitStack() as stack:
        if "rerun" in wanted:
            writers.append(stack.enter_context(recording(folder / "recording.rrd", inputs)))
        for frame_id in run.frame_ids:
            # All writers of a frame share what is read and computed.
            frame = RunFrame(inputs, frame_id)
            for write in writers:
                write(frame)
            tell(frame_id)


def _columns(line: KittiObject) -> dict[str, Any]:
    return {
        "line": line.line_number,
        "type": line.type,
        "truncated": line.truncated,
        "occluded": line.occluded,
        "alpha": line.alpha,
        "bbox": list(line.box_2d),
        "dimensions_hwl": list(line.hwl),
        "location": list(line.location_ref),
        "rotation_y": line.rotation_y,
        "score": line.score,
    }


def _refinement(result: FrameResult, line: KittiObject) -> dict[str, Any]:
    shapes = result.shapes
    car = next((car for car, number in enumerate(shapes.input_lines) if number == line.line_number), None)
    if car is None:
        return {"status": "copied"}
    known = {
        "sigma_xyz_yaw": shapes.sigmas_ref[car],
        "probability_better": shapes.probabilities_better[car],
        "probability_not_worse": shapes.probabilities_not_worse[car],
        "probability_heading": shapes.probabilities_heading[car],
        "mask_iou_left": shapes.mask_iou_left[car],
        "mask_iou_right": shapes.mask_iou_right[car],
        "code": shapes.codes[car],
    }
    return {"status": shapes.statuses[car], **json_values(known)}
