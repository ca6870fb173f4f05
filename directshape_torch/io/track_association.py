"""This module associates detections of consecutive frames that show one car, by overlap of boxes and their motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.mask_matching import assign

# A car that is missing in more consecutive frames than this gets a new track.
_LONGEST_GAP = 2
_LEAST_OVERLAP = 0.3
# The depths of a car in consecutive frames have a smaller ratio, including detector errors and oncoming traffic.
_DEPTH_RATIO = 1.5


@dataclass
class _Track:
    track_id: int
    last: KittiObject
    frame: int
    motion_px: NDArray[np.float64]  # (4,) of the box's edges from frame to frame

    def box_at(self, frame: int) -> NDArray[np.float64]:
        return np.array(self.last.box_2d) + (frame - self.frame) * self.motion_px

    def gone_on(self, found: KittiObject, frame: int) -> _Track:
        self.motion_px = (np.array(found.box_2d) - np.array(self.last.box_2d)) / (frame - self.frame)
        self.last, self.frame = found, frame
        return self


def associate(frames: Sequence[Sequence[KittiObject]]) -> list[list[int]]:
    """Number the objects of consecutive frames from 0; objects without a 3D box get -1.

    Each frame is matched by the assignment of largest total overlap (Hungarian) between its 2D boxes and the boxes of
    earlier frames, moved at the speed of their edges. Only objects of one type whose depths differ by less than half
    are matched. An object without a partner begins a track. A track that is not found for more than two frames ends.

    Examples:
        >>> from directshape_torch.io.kitti_labels import parse_object
        >>> from directshape_torch.files.text_files import Line
        >>> def car(u): return parse_object("f", Line(1, f"Car 0 0 0 {u} 9 {u + 40} 49 1.5 1.6 3.9 1 1.6 20 0", ""))
        >>> associate([[car(100), car(300)], [car(290), car(110)], [car(120), car(600)]])
        [[0, 1], [1, 0], [0, 2]]
    """
    tracks: list[_Track] = []
    numbers = []
    num_tracks = 0
    for frame, objects in enumerate(frames):
        tracks = [track for track in tracks if frame - track.frame <= _LONGEST_GAP + 1]
        found = [number for number, each in enumerate(objects) if each.has_box_3d]
        overlap = _overlaps([objects[number] for number in found], tracks, frame)
        partners = assign(np.where(overlap >= _LEAST_OVERLAP, overlap, 0.0))
        ids = [-1] * len(objects)
        for number, partner in zip(found, partners, strict=True):
            if partner >= 0:
                track = tracks[partner].gone_on(objects[number], frame)
            else:
                track = _Track(num_tracks, objects[number], frame, np.zeros(4))
                tracks.append(track)
                num_tracks += 1
            ids[number] = track.track_id
        numbers.append(ids)
    return numbers


def _overlaps(objects: Sequence[KittiObject], tracks: Sequence[_Track], frame: int) -> NDArray[np.float64]:  # (B, T)
    boxes = np.array([each.box_2d for each in objects]).reshape(-1, 4)
    overlap = box_iou(boxes, np.array([track.box_at(frame) for track in tracks]).reshape(-1, 4))
    depths, last = (np.array([o.location_ref[2] for o in some]) for some in (objects, [t.last for t in tracks]))
    ratio = np.maximum(depths[:, None], 0.1) / np.maximum(last[None], 0.1)
    types, last_types = (np.array([o.type for o in some], str) for some in (objects, [t.last for t in tracks]))
    possible = (types[:, None] == last_types[None]) & (np.maximum(ratio, 1 / ratio) < _DEPTH_RATIO)
    return np.where(possible, np.nan_to_num(overlap), 0.0)
