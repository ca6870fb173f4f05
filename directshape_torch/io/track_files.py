"""`tracks/NAME.npz` of a run (schema 1): one car through the frames, its shape and its poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.result_files import (
    Floats,
    ShapeArrays,
    check_shapes,
    read_arrays,
    read_shapes,
    shaped,
    write_arrays,
)
from directshape_torch.io.run_folder import shapes_path
from directshape_torch.status import Status

TRACK_SCHEMA_VERSION = 1


@dataclass(frozen=True)
class TrackArrays:
    """A car in F frames, K codes, D = 6 + K; each view as its frame's `ShapeArrays` has it."""

    track: str
    prior_sha256: str  # of the shape prior whose codes these are
    # Its shape, that of the refined view which knows it best; NaN where no view was refined.
    code: Floats = field(metadata=shaped("K"))
    code_covariance: Floats = field(metadata=shaped("K", "K"))  # of it
    dimensions_hwl: Floats = field(metadata=shaped(3))  # of that shape, metres
    frame_ids: tuple[str, ...] = field(metadata=shaped("F"))  # text, in the order of the frames
    input_lines: NDArray[np.int64] = field(metadata=shaped("F"))  # line numbers in the detection files, from 1
    statuses: tuple[str, ...] = field(metadata=shaped("F"))  # text
    # 0 for views that share a shape, 1, 2 .. for later ones that cannot be the same car, -1 for a view that shares
    # with none.
    parts: NDArray[np.int64] = field(metadata=shaped("F"))
    # Object to left camera, and to the frame of the labels.
    T_cam_obj: Floats = field(metadata=shaped("F", 4, 4))
    T_ref_obj: Floats = field(metadata=shaped("F", 4, 4))
    # And boxes_rotation_y (F,): the boxes of the result lines.
    boxes_hwl: Floats = field(metadata=shaped("F", 3))
    boxes_location_ref: Floats = field(metadata=shaped("F", 3))
    boxes_rotation_y: Floats = field(metadata=shaped("F"))
    # One and the same in all views of a call; views that were not trusted keep their own.
    codes: Floats = field(metadata=shaped("F", "K"))
    # In the tangent (v, omega, code) of the solver; NaN where there is none.
    covariances: Floats = field(metadata=shaped("F", "D", "D"))

    def __post_init__(self) -> None:
        check_shapes(self, {"F": len(self.frame_ids), "K": self.codes.shape[-1], "D": 6 + self.codes.shape[-1]})


def track_name(sequence: str, track_id: int) -> str:
    """What the files of a track are called.

    Examples:
        >>> track_name("", 7), track_name("0005", 31), track_name("0005", -1)
        ('000007', '0005_000031', '')
    """
    if track_id < 0:
        return ""
    return f"{sequence}_{track_id:06d}" if sequence else f"{track_id:06d}"


def track_path(out_dir: Path | str, track: str) -> Path:
    """The file of a track."""
    return Path(out_dir) / "tracks" / f"{track}.npz"


def read_track(path: Path | str) -> TrackArrays:
    """Read a file of `write_tracks`.

    Raises:
        DataFormatError: it is no such file, of another schema version, or changed since it was written.
    """
    return read_arrays(path, TrackArrays, TRACK_SCHEMA_VERSION)


def write_tracks(out_dir: Path | str, frame_ids: Iterable[str]) -> None:
    """Write the file of every track that goes through some finished frames of a run, from their shapes.

    Args:
        out_dir: the folder of the run.
        frame_ids: finished frames, in their order.

    Raises:
        DataFormatError: the shapes of a frame are missing or damaged.
    """
    views: dict[str, list[tuple[ShapeArrays, int]]] = {}
    for frame_id in frame_ids:
        shapes = read_shapes(shapes_path(out_dir, frame_id))
        for car, track in enumerate(shapes.tracks):
            if track:
                views.setdefault(track, []).append((shapes, car))
    for track, cars in views.items():
        write_arrays(track_path(out_dir, track), _track(track, cars), TRACK_SCHEMA_VERSION)


def _track(track: str, views: list[tuple[ShapeArrays, int]]) -> TrackArrays:
    def stacked(name: str) -> NDArray[np.float64]:
        return np.stack([getattr(shapes, name)[car] for shapes, car in views])

    statuses = tuple(shapes.statuses[car] for shapes, car in views)
    codes, covariances = stacked("codes"), stacked("covariances")
    is_refined = np.array([Status[status].is_refined for status in statuses])
    # A view that was not refined knows nothing, and a covariance that is not finite says nothing.
    variance = np.trace(covariances[:, 6:, 6:], axis1=1, axis2=2)
    best = int(np.argmin(np.where(is_refined & np.isfinite(variance), variance, np.inf)))
    unknown = 1.0 if is_refined.any() else np.nan
    boxes_hwl = stacked("boxes_hwl")
    return TrackArrays(
        track=track,
        prior_sha256=views[0][0].prior_sha256,
        code=codes[best] * unknown,
        code_covariance=covariances[best, 6:, 6:] * unknown,
        dimensions_hwl=boxes_hwl[best] * unknown,
        frame_ids=tuple(shapes.frame_id for shapes, _ in views),
        input_lines=stacked("input_lines").astype(np.int64),
        statuses=statuses,
        parts=stacked("track_parts").astype(np.int64),
        T_cam_obj=stacked("T_cam_obj"),
        T_ref_obj=stacked("T_ref_obj"),
        boxes_hwl=boxes_hwl,
        boxes_location_ref=stacked("boxes_location_ref"),
        boxes_rotation_y=stacked("boxes_rotation_y"),
        codes=codes,
        covariances=covariances,
    )
