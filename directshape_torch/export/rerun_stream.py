"""A Rerun recording that is under way: its file, its timelines, and how the viewer opens it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import MissingDependencyError

if TYPE_CHECKING:
    import trimesh

# The timelines: numbers of frames; iterations of all frames, one after another.
_FRAME, _ITERATION = "frame", "iteration"
_STATES_PER_SECOND = 3.0


def import_rerun() -> Any:
    """The package `rerun`.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise MissingDependencyError("rerun-sdk", "viewer", "a Rerun recording") from error
    return rerun


class RerunStream:
    """Writes a recording beside its place, and moves it there when it is whole.

    Args:
        path: of the .rrd file; its folder is made where it is missing.
        size_wh: of the images, which the viewer fits its views to.
        with_iterations: whether there is a timeline of iterations to look at.

    Raises:
        MissingDependencyError: Rerun is not installed.
    """

    def __init__(self, path: Path, size_wh: tuple[int, int], with_iterations: bool = False) -> None:
        self.rr, self.path = import_rerun(), path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = self.rr.RecordingStream("directshape", send_properties=False)
        self._stream.save(self._temporary, default_blueprint=_blueprint(size_wh, with_iterations))
        # When a line was written says nothing about the refinement.
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)

    def at(self, frame: int | None = None, iteration: int | None = None) -> None:
        """What is logged from here on belongs to these places of the two timelines, or to none of theirs."""
        self._stream.reset_time()
        for timeline, place in ((_FRAME, frame), (_ITERATION, iteration)):
            if place is not None:
                self._stream.set_time(timeline, sequence=place)

    def log(self, entity: str, *archetypes: Any, static: bool = False) -> None:
        """Log at the present places; `static` for what holds at all times.

        Raises:
            ValueError: Rerun does not take the data; its own default is a line on stderr.
        """
        self._stream.log(entity, *archetypes, static=static, strict=True)

    def log_mesh(
        self,
        entity: str,
        mesh: trimesh.Trimesh,
        colours: NDArray[np.uint8] | None = None,
        colour: tuple[int, int, int] | None = None,
    ) -> None:
        """Triangles with a colour for each vertex, or one for all."""
        made = self.rr.Mesh3D(
            vertex_positions=np.asarray(mesh.vertices, dtype=np.float32),
            triangle_indices=np.asarray(mesh.faces, dtype=np.uint32),
            vertex_normals=np.asarray(mesh.vertex_normals, dtype=np.float32),
            vertex_colors=colours,
            albedo_factor=None if colour is None else [*colour, 255],
        )
        self.log(entity, made)

    def log_boxes(
        self,
        entity: str,
        T_cam_box: NDArray[np.float64],  # (B, 4, 4) at the middle of the bottom, y down
        hwl: NDArray[np.float64],  # (B, 3)
        colours: Sequence[tuple[int, int, int]],
        labels: Sequence[str],
    ) -> None:
        """Boxes with length, height, width along the axes of their objects."""
        from scipy.spatial.transform import Rotation

        hwl, T_cam_box = hwl.reshape(-1, 3), T_cam_box.reshape(-1, 4, 4)
        quaternions = Rotation.from_matrix(T_cam_box[:, :3, :3]).as_quat() if len(hwl) else np.zeros((0, 4))
        boxes = self.rr.Boxes3D(
            centers=T_cam_box[:, :3, 3] - 0.5 * hwl[:, :1] * T_cam_box[:, :3, 1],
            half_sizes=0.5 * hwl[:, [2, 0, 1]],
            quaternions=[self.rr.Quaternion(xyzw=q) for q in quaternions],
            colors=np.array(colours, dtype=np.uint8).reshape(-1, 3),
            labels=list(labels),
            show_labels=False,
            fill_mode=self.rr.components.FillMode.MajorWireframe,
        )
        self.log(entity, boxes)

    def close(self, keep: bool = True) -> None:
        """Write the end and move the file to its place, or leave none behind."""
        self._stream.flush()
        self._stream.disconnect()
        if keep:
            os.replace(self._temporary, self.path)
        else:
            self._temporary.unlink(missing_ok=True)


def _blueprint(size_wh: tuple[int, int], with_iterations: bool) -> Any:
    """3D view on the left; images on the right, and with iterations residuals and costs."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=[0, size_wh[0]], y_range=[0, size_wh[1]])
    camera, left, right = "world/cam", "world/cam/image", "right/image"

    def image(name: str, origin: str, *contents: str) -> Any:
        return rrb.Spatial2DView(origin=origin, name=name, contents=list(contents), visual_bounds=bounds)

    views = [image("left: masks and boxes", camera, left, f"{left}/masks", "world/boxes/**")]
    seen_right = image("right: masks", "right", right, f"{right}/masks")
    if with_iterations:
        photometric = image("left: right image less left", left, left, f"{left}/photometric/**")
        silhouettes = [
            image(f"{side}: silhouettes", entity, entity, f"{entity}/silhouette/**")
            for side, entity in (("left", left), ("right", right))
        ]
        views += [photometric, rrb.Tabs(*silhouettes, seen_right)]
        views.append(rrb.TimeSeriesView(origin="cost", name="cost of each car"))
    else:
        views.append(seen_right)
    # Above and behind the camera, so that the street lies ahead.
    eye = rrb.EyeControls3D(position=[-7.0, -8.0, -9.0], look_target=[1.0, 1.0, 14.0], eye_up=[0.0, -1.0, 0.0])
    timeline = _ITERATION if with_iterations else _FRAME
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin="world", name="3D", eye_controls=eye), rrb.Vertical(*views)),
        rrb.TimePanel(timeline=timeline, fps=_STATES_PER_SECOND, play_state="paused"),
        collapse_panels=True,
    )
