"""This module tells which instance of a mask file each detection of a frame got."""

from __future__ import annotations

import numpy as np

from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset


def instances(dataset: StereoDataset, loaded: LoadedFrame) -> tuple[list[int], list[int]]:
    """Instance numbers of the file for the left and for the right image, -1 for none."""
    height, width = loaded.frame.sizes[0].tolist()
    masks = [] if dataset.masks is None else dataset.masks.read(loaded.frame_id, (height, width))

    def number(side: str, probability: np.ndarray) -> int:
        same = (m for m in masks if m.side == side and np.array_equal(m.whole((height, width)), probability > 0.5))
        return next((mask.instance_id for mask in same), -1)

    found = loaded.detections
    left, right = found.mask_left.dense().float().numpy(), found.mask_right.dense().float().numpy()
    return [number("left", mask) for mask in left], [number("right", mask) for mask in right]
