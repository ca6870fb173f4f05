"""The part of `directshape inspect` that refines a frame, finds what is true of its cars, and has them drawn."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.cli.progress import Bar
from directshape_torch.errors import InputError
from directshape_torch.evaluation.matching import match_to_labels
from directshape_torch.evaluation.shape_truth import SurfaceSource
from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.camera import project, rays_from_pixels
from directshape_torch.io.frame_layout import FrameLayout, first_disparity
from directshape_torch.io.kitti_labels import box_corners_cam
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.disparity_maps import FOLDERS, known_depth_from_disparity_map
from directshape_torch.rig.disparity_observations import KnownDepth
from directshape_torch.rig.lidar import known_depth_from_lidar
from directshape_torch.stereo_matching.disparity import with_disparity
from directshape_torch.visualize.inspection.car_figures import write_car_figures
from directshape_torch.visualize.inspection.car_view import CarView, KnownPoints
from directshape_torch.visualize.inspection.point_figures import stereo_points
from directshape_torch.visualize.overlay import overlay_of_frame
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement, without_photometry

# Points under the mask's edge may lie far behind the car.
_REACH_M = 3.5


class TruePoints(NamedTuple):
    """Points that the left image of a frame shows."""

    name: str
    points_cam: NDArray[np.float64]  # (P, 3) metres
    uv: NDArray[np.float64]  # (P, 2) pixels


def inspect_frame(
    loaded: LoadedFrame,
    refiner: DirectShapeRefiner,
    rows: Sequence[int],
    root: Path,
    layout: FrameLayout,
    out_dir: Path,
    *,
    must_refine: bool = False,
) -> None:
    """Refine all cars of a frame and draw some: `FRAME.png`, and a folder `FRAME_LINE` a car.

    Args:
        loaded: the frame, on the CPU.
        refiner: on the CPU too.
        rows: of the detections to draw.
        root: folder of the data set, for true disparity and the like.
        layout: of that folder, for scans.
        out_dir: made where it is missing.
        must_refine: draw nothing where one of them cannot be refined.

    Raises:
        InputError: such a car was not refined; says why.
    """
    # Matched once, for the point figure and for the methods that fit points; the others do not look at it.
    loaded = replace(loaded, frame=with_disparity(loaded.frame, refiner.config.point_cloud.matcher))
    trace = trace_refinement(refiner, loaded.frame, loaded.detections)
    _report(loaded, trace, rows, must_refine)
    write_png(out_dir / f"{loaded.frame_id}.png", overlay_of_frame(loaded, trace.result))
    drawn = [row for row in rows if trace.place_of(row) >= 0]
    silhouettes = silhouette_trace(refiner, loaded) if drawn else None
    clouds = stereo_points(loaded.frame, loaded.detections, refiner.config.point_cloud) if drawn else []
    truth, known = true_corners_cam(loaded), true_points(root, layout, loaded)
    for row in Bar(drawn, unit="car", desc=f"frame {loaded.frame_id}", file=sys.stderr):
        line = line_of(loaded, row)
        centre_cam = trace.T_cam_obj[-1][row, :3, 3]
        points = points_of_car(known, loaded, row, centre_cam)
        view = CarView(loaded, trace, row, truth[row], points, clouds[row])
        by_silhouettes = None
        if silhouettes is not None and silhouettes.place_of(row) >= 0:
            by_silhouettes = CarView(loaded, silhouettes, row, truth[row], points)
        write_car_figures(out_dir / f"{loaded.frame_id}_{line}", view, by_silhouettes)


def silhouette_trace(refiner: DirectShapeRefiner, loaded: LoadedFrame) -> RefinementTrace | None:
    """Of a refinement by silhouettes and priors alone; None where the refiner lacks one of the paper's terms."""
    config = refiner.config
    if config.method != "direct" or not (config.photometric.weight > 0 and config.silhouette.weight > 0):
        return None
    return trace_refinement(without_photometry(refiner), loaded.frame, loaded.detections)


def _report(loaded: LoadedFrame, trace: RefinementTrace, rows: Sequence[int], must_refine: bool) -> None:
    """A line a car: how it ended, its cost before and after."""
    result = trace.result
    for row in rows:
        status = result.status[row]
        name = f"frame {loaded.frame_id} car {line_of(loaded, row)}"
        if trace.place_of(row) < 0:
            if must_refine:
                raise InputError("--car", "a car that can be refined", f"{status.name} ({status.value})")
            print(f"{name}: not refined, {status.name}: {status.value}")
            continue
        before, after = (float(costs[row].sum()) for costs in (result.cost_before, trace.costs[-1]))
        moved = int(trace.accepted[:, row].sum())
        print(f"{name}: {status.name}, cost {before:.2f} -> {after:.2f} in {moved} steps")


def line_of(loaded: LoadedFrame, row: int) -> int:
    """Number of the line of a detection in its file."""
    return loaded.detected_objects[row].line_number


def true_corners_cam(loaded: LoadedFrame) -> list[NDArray[np.float64] | None]:
    """Corners (8, 3) of the labelled box of each detection, or None."""
    labels = loaded.labels or []
    partners = match_to_labels(loaded.detected_objects, labels)
    corners = box_corners_cam(labels, loaded.frame.camera.t_cam_ref[0]).numpy()
    return [None if partner < 0 else corners[partner] for partner in partners]


def true_points(root: Path, layout: FrameLayout, loaded: LoadedFrame) -> TruePoints | None:
    """The scan of a frame, or true disparity or surfaces in KITTI's folder `training`, the first that there is.

    Args:
        root: folder of the data set.
        layout: knows where the scan is.
        loaded: the frame.

    Raises:
        DataFormatError: a file is there and cannot be used.
    """
    training, frame_id, camera = root / "training", loaded.frame_id, loaded.frame.camera
    height, width = loaded.frame.sizes[0].tolist()
    scan = layout.scan(frame_id)
    if scan is not None:
        return _of_depth("LiDAR", known_depth_from_lidar(*scan, (width, height), camera), loaded)
    for folder in FOLDERS:
        disparity = first_disparity(training / folder, frame_id)
        if disparity.is_file():
            known = known_depth_from_disparity_map(disparity, (width, height), camera)
            return _of_depth("true disparity", known, loaded)
    return _of_surfaces(training, loaded)


def points_of_car(
    points: TruePoints | None, loaded: LoadedFrame, car: int, centre_cam: torch.Tensor
) -> KnownPoints | None:
    """The points of a frame and which of them are on a car: those in its left mask that are near its centre.

    Args:
        points: of the frame.
        loaded: the frame.
        car: row of the detections.
        centre_cam: (3,) a point of the car, metres.
    """
    if points is None:
        return None
    mask = loaded.detections.mask_left[car].numpy()
    u, v = np.rint(points.uv).astype(np.int64).T
    under_mask = mask[v, u] > MASK_THRESHOLD
    near = np.linalg.norm(points.points_cam - centre_cam.double().numpy(), axis=1) < _REACH_M
    return KnownPoints(points.name, points.points_cam, points.uv, np.asarray(under_mask & near))


def _of_depth(name: str, known: KnownDepth, loaded: LoadedFrame) -> TruePoints:
    rays = rays_from_pixels(known.uv_left, loaded.frame.camera.K_left[0].double())
    return TruePoints(name, (known.depth_m[:, None] * rays).numpy(), known.uv_left.numpy())


def _of_surfaces(training: Path, loaded: LoadedFrame) -> TruePoints | None:
    """The visible points of all labelled cars of a rendered scene."""
    camera, frame_id = loaded.frame.camera, loaded.frame_id
    if loaded.labels is None or not any((training / "points").glob(f"{frame_id}_*.npz")):
        return None
    truths = SurfaceSource(training).truths(frame_id, loaded.labels, camera).values()
    visible = np.concatenate([truth.points_cam[truth.visible] for truth in truths])
    uv = project(torch.from_numpy(visible), camera.K_left[0].double()).numpy()
    return TruePoints("true surface", visible, uv)
