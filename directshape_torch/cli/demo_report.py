"""What `directshape demo` shows: a table of errors before and after, and the refined cars as one 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from directshape_torch.batch.mesh_files import scene_bytes
from directshape_torch.evaluation.matching import match_to_labels
from directshape_torch.evaluation.pose_error import PoseErrors, boxes_of, pose_errors
from directshape_torch.evaluation.tables import align
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import result_path, shapes_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.status import Status
from directshape_torch.visualize.ground_grid import ground_grid

if TYPE_CHECKING:
    import trimesh

# Paints that are easy to tell apart.
_PAINTS_RGB = ((66, 135, 245), (235, 120, 50), (80, 190, 110), (205, 80, 160), (230, 195, 60), (120, 110, 220))


def error_table(loaded: LoadedFrame, out_dir: Path) -> str:
    """Centre, heading and bird's-eye overlap of each car against its label, before and after."""
    lines = list(loaded.row_of_detection)
    before = [loaded.input_objects[line] for line in lines]
    refined = read_objects(result_path(out_dir, loaded.frame_id))
    after = [refined[line] for line in lines]
    statuses = read_shapes(shapes_path(out_dir, loaded.frame_id)).statuses
    labels = loaded.labels or []
    partners = match_to_labels(before, labels)
    rows = [["car", "depth", "centre [m]", "yaw [deg]", "BEV IoU", "status"]]
    pairs = [car for car, partner in enumerate(partners) if partner >= 0]
    true = [labels[partners[car]] for car in pairs]
    errors = [_errors([objects[car] for car in pairs], true) for objects in (before, after)]
    for row, car in enumerate(pairs):
        depth = f"{true[row].location_ref[2]:.1f} m"
        rows.append([str(before[car].line_number), depth, *_columns(errors, [row]), statuses[car]])
    if pairs:
        rows.append(["mean", "", *_columns(errors, range(len(pairs))), ""])
    return align(rows)


def write_scene(path: Path, loaded: LoadedFrame, out_dir: Path, prior: ShapePrior) -> None:
    """All refined cars of a frame, painted, on a grid of 5 m, as binary glTF."""
    shapes = read_shapes(shapes_path(out_dir, loaded.frame_id))
    meshes: dict[str, trimesh.Trimesh] = {}
    for car, status in enumerate(shapes.statuses):
        if Status[status].is_refined:
            code = torch.from_numpy(shapes.codes[car : car + 1]).to(prior.origin)
            T_cam_obj = torch.from_numpy(shapes.T_cam_obj[car])
            mesh = sdf_to_mesh(prior.values(code)[0], prior.origin, prior.spacing_m, T_cam_obj)
            _paint(mesh, _PAINTS_RGB[car % len(_PAINTS_RGB)])
            meshes[f"car_{shapes.input_lines[car]}"] = mesh
    meshes["ground"] = ground_grid(loaded.frame.ground.normal[0], float(loaded.frame.ground.offset[0]))
    _paint(meshes["ground"], (120, 120, 120))
    write_bytes(path, scene_bytes(meshes))


def _paint(mesh: trimesh.Trimesh, rgb: tuple[int, int, int]) -> None:
    from trimesh.visual import ColorVisuals

    mesh.visual = ColorVisuals(mesh, vertex_colors=[[*rgb, 255]] * len(mesh.vertices))


def _errors(objects: Sequence[KittiObject], true: Sequence[KittiObject]) -> PoseErrors[Tensor]:
    return pose_errors(boxes_of(objects), boxes_of(true))


def _columns(errors: Sequence[PoseErrors[Tensor]], rows: Sequence[int]) -> tuple[str, str, str]:
    """Before and after of centre, yaw and overlap, averaged over the rows."""

    def change(name: str, decimals: int) -> str:
        values = [float(getattr(e, name)[list(rows)].mean()) for e in errors]
        return " -> ".join(f"{value:{decimals + 3}.{decimals}f}" for value in values)

    return change("centre_m", 2), change("yaw_deg", 1), change("bev_iou", 2)
