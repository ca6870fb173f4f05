"""All files of one refined frame, and its entry in `summary.json`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from directshape_torch.batch.options import RefineOptions
from directshape_torch.io.atomic_files import write_png
from directshape_torch.io.kitti_dataset import LoadedFrame
from directshape_torch.io.refinement_files import write_refinement
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
) -> None:
    """Write what the options ask for; the result file comes last, so that where it exists the frame is complete.

    Args:
        out_dir: the output folder.
        loaded: the frame.
        result: of a call with this frame's detections, alone or in a batch.
        first_row: where the frame's detections begin in `result`.
        prior_sha256: of the shape prior.
        options: kinds of files.
    """
    if options.meshes is not None:
        from directshape_torch.batch.mesh_files import write_car_meshes

        write_car_meshes(out_dir, loaded, result, first_row, options.meshes)
    if options.overlays:
        from directshape_torch.visualize.overlay import overlay_of_frame

        write_png(overlay_path(out_dir, loaded.frame_id), overlay_of_frame(loaded, result, first_row))
    write_refinement(out_dir, loaded, result, prior_sha256, first_row)


def frame_entry(
    loaded: LoadedFrame, result: RefinementResult, first_row: int, options: RefineOptions
) -> dict[str, Any]:
    """The entry of a finished frame; it lists the meshes, because which cars have one only the result knows."""
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
        "mesh_files": _mesh_files(loaded, result, first_row, options),
    }


def _mesh_files(loaded: LoadedFrame, result: RefinementResult, first_row: int, options: RefineOptions) -> list[str]:
    """Paths in the output folder."""
    if options.meshes is None:
        return []
    from directshape_torch.batch.mesh_files import car_mesh_paths

    return sorted(
        path.as_posix() for path in car_mesh_paths(Path(), loaded, result, first_row, options.meshes).values()
    )


def failed_entry(reason: str) -> dict[str, Any]:
    """The entry of a frame that could not be refined."""
    return {"state": "failed", "reason": reason}
