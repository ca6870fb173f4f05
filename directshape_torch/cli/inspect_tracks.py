"""The part of `directshape inspect` that refines frames together and lets each car of several frames move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from directshape_torch.io.figure_files import write_animation
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.io.track_files import track_name
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.drawing import Picture, View, draw_box, draw_contour, draw_text
from directshape_torch.visualize.drawn_car import DrawnCar, drawn_cars

_SIZE_PX = (480, 360)
_SECONDS_A_FRAME = 0.4
_MARGIN = 1.3


def inspect_tracks(loaded: Sequence[LoadedFrame], refiner: DirectShapeRefiner, out_dir: Path) -> list[Path]:
    """Refine frames in one call and write `track_NAME.gif` for each car that several of them show.

    Args:
        loaded: frames of one rig, whose cars have tracks; on the CPU.
        refiner: on the CPU too.
        out_dir: made where it is missing.
    """
    with torch.no_grad():
        result = refiner(*collate(loaded))
    pictures: dict[str, list[Picture]] = {}
    first_row = 0
    for item in loaded:
        ids, part = item.detections.track_id, result[first_row : first_row + len(item.detections)]
        for car, number in zip(drawn_cars(item, part)[1], [] if ids is None else ids.tolist(), strict=True):
            pictures.setdefault(track_name(item.sequence or "", number), []).append(_picture(item, car))
        first_row += len(item.detections)
    paths = []
    for name, frames in pictures.items():
        if name and len(frames) > 1:
            paths.append(out_dir / f"track_{name}.gif")
            write_animation(paths[-1], frames, [_SECONDS_A_FRAME] * len(frames))
    return paths


def _picture(item: LoadedFrame, car: DrawnCar) -> Picture:
    """The car's part of the left image, with its box and contour; all of one size."""
    image = View.of_frame(item.frame)
    ahead = car.corners_cam[car.corners_cam[:, 2] > 0.5]
    pixels = image.project(ahead if len(ahead) else np.array([[0.0, 0.0, 1.0]]))
    (u0, v0), (u1, v1) = pixels.min(axis=0), pixels.max(axis=0)
    height = round(max(_MARGIN * (v1 - v0), _MARGIN * (u1 - u0) * _SIZE_PX[1] / _SIZE_PX[0], 12.0) / 3) * 3
    width = height * 4 // 3
    left, top = round((u0 + u1 - width) / 2), round((v0 + v1 - height) / 2)
    view = image.part((left, top, left + width, top + height), _SIZE_PX[0] / width)
    draw_box(view, car.corners_cam, car.colour)
    if car.surface is not None:
        draw_contour(view, car.surface, car.colour)
    draw_text(view.picture, f"{item.frame_id}: {car.distance_m:.1f} m, {car.status}", (8, 20))
    return view.picture
