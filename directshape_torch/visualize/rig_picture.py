"""Picture of the estimates of one or several rigs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.visualize.disparity_field_picture import Picture, draw_disparity_field, titled


def draw_rigs(
    rigs: Sequence[RigEstimate],  # at least one
) -> Picture:  # (H, W, 3) RGB
    """One below the other: what was found in words, the field, the detections' offsets before it and after.

    The offsets are less the detector's own bias.

    Examples:
        >>> import torch
        >>> K, T_right_cam = torch.eye(3), torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> draw_rigs([RigEstimate((320, 96), K, K, T_right_cam)]).shape
        (424, 320, 3)
    """
    pictures = [_draw(rig) for rig in rigs]
    width = max(picture.shape[1] for picture in pictures)
    padded = [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in pictures]
    return np.concatenate(padded)


def _draw(rig: RigEstimate) -> Picture:
    offset = rig.rows[:, 3] - rig.detector.bias * rig.rows[:, 2]
    return titled(str(rig), draw_disparity_field(rig.field, rig.rows[:, :2], offset))
