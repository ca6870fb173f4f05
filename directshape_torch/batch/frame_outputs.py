"""All files of one refined frame, and its entry in `summary.json`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from directshape_torch.batch.options import RefineOptions
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.refinement_files import result_path, shapes_path, write_refinement
from directshape_torch.io.run_manifest import hash_bytes
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.result import RefinementResult


def overlay_path(out_dir: Path, frame_id: str) -> Path:
    """The picture of a frame."""
    return out_dir / "overlays" / f"{frame_id}.png"


def write_frame_outputs(
    out_dir: Path,
    loaded: LoadedFrame,
    result: RefinementResult,
    first_row: int,
    prior_sha256: str,
    options: RefineOptions,
) -> dict[str, str]:
    """Write what the options ask for; the result file comes last, so that where it exists the frame is complete.

    Args:
        out_dir: the output folder.
        loaded: the frame.
        result: of a call with this frame's detections, alone or in a batch.
        first_row: where the frame's detections begin in `result`.
        prior_sha256: of the shape prior.
        options: kinds of files.

    Returns:
        The sha256 of each file, by its path in the output folder.
    """
    files = [result_path(out_dir, loaded.frame_id), shapes_path(out_dir, loaded.frame_id)]
    if options.meshes is not None:
        from directshape_torch.batch.mesh_files import write_car_meshes

        files += write_car_meshes(out_dir, loaded, result, first_row, options.meshes)
    if options.overlays:
        from directshape_torch.visualize.overlay import overlay_of_frame

        files.append(overlay_path(out_dir, loaded.frame_id))
        write_png(files[-1], overlay_of_frame(loaded, result, first_row))
    write_refinement(out_dir, loaded, result, prior_sha256, first_row)
    return {path.relative_to(out_dir).as_posix(): hash_bytes(path.read_bytes()) for path in files}


def frame_entry(
    loaded: LoadedFrame, result: RefinementResult, first_row: int, options: RefineOptions, files: Mapping[str, str]
) -> dict[str, Any]:
    """The entry of a finished frame; its files are those of `write_frame_outputs`."""
    num_cars = len(loaded.detections)
    statuses = Counter(status.name for status in result.status[first_row : first_row + num_cars])
    return {
        "state": "done",
        "lines": len(loaded.input_objects),
        "cars": num_cars,
        "masks_left": int(loaded.detections.has_mask_left.sum()),
        "masks_right": int(loaded.detections.has_mask_right.sum()),
        "ground_source": loaded.frame.ground.source[0],
        "statuses": dict(statuses),
        "outputs": sorted(options.outputs),
        "mesh_files": sorted(name for name in files if name.startswith("meshes/")),
        "files": dict(files),
    }


def failed_entry(reason: str) -> dict[str, Any]:
    """The entry of a frame that could not be refined."""
    return {"state": "failed", "reason": reason}
