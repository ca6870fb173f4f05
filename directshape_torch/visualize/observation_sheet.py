"""What the refinement looks at, for one car: its pixels of both rounds, and what hides it (paper, both figures)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from directshape_torch.config import SamplingConfig
from directshape_torch.observation.packing import car_regions
from directshape_torch.observation.sampling import sampling_settings, selected_pixels
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.visualize.drawing import WHITE, draw_text, text_size_for
from directshape_torch.visualize.sampling_picture import (
    BLUE,
    GREEN,
    RED,
    YELLOW,
    occlusion_picture,
    sampling_picture,
)

Picture = NDArray[np.uint8]
_HEIGHT_PX = 320
_LEGEND_PX, _SWATCH_PX = 30, 18
_LEGEND = (
    ("strong gradient", GREEN),
    ("strongest of its cell", RED),
    ("region", YELLOW),
    ("mask of the car", BLUE),
    ("hidden by a nearer car", WHITE),
)


def observation_sheet(
    frames: FrameBatch, detections: Detections, object_number: int, config: SamplingConfig | None = None
) -> Picture:
    """Sampled pixels (green: above the threshold, red: the strongest of their cell), masks and occlusion mask.

    Args:
        frames, detections: the scene.
        object_number: the car; it needs a mask in the left image.
        config: how pixels are sampled; default the refiner's.

    Returns:
        (350, w, 3) RGB uint8: pixels, image, masks and occlusion mask, with a legend below.

    Raises:
        InputError: no such car, or one without pixels in the left image.
    """
    config = SamplingConfig() if config is None else config
    left, _ = car_regions(frames, detections)
    settings = sampling_settings(config, "left")
    chosen = selected_pixels(frames.images_left, frames.sizes, detections.frame_index, left, settings)
    order = config.occlusion_order
    panels = [
        sampling_picture(frames, detections, left, chosen, object_number, order=order),
        occlusion_picture(frames, detections, left, object_number, order=order),
    ]
    sheet = np.concatenate([_of_height(panel) for panel in panels], axis=1)
    return np.concatenate([sheet, _legend(sheet.shape[1])])


def _legend(width: int) -> Picture:
    """What the colours mean, in one line."""
    strip = np.full((_LEGEND_PX, width, 3), 24, np.uint8)
    names = "   ".join(name for name, _ in _LEGEND)
    size = text_size_for(names, width - 20 - _SWATCH_PX * len(_LEGEND), 0.7)
    u = 10
    for name, colour in _LEGEND:
        cv2.circle(strip, (u + 5, _LEGEND_PX // 2), 5, colour, -1, cv2.LINE_AA)
        draw_text(strip, name, (u + 16, _LEGEND_PX // 2 + 7), size=size)
        u += _SWATCH_PX + cv2.getTextSize(name + "   ", cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0]
    return strip


def _of_height(picture: Picture) -> Picture:
    width = max(1, round(picture.shape[1] * _HEIGHT_PX / picture.shape[0]))
    return np.asarray(cv2.resize(picture, (width, _HEIGHT_PX), interpolation=cv2.INTER_AREA), dtype=np.uint8)
