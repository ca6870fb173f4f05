"""Pictures of the adaptive pixel sampling and of the occlusion masks, like the two figures of the paper."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.occlusion import (
    OcclusionOrder,
    Side,
    instances_in_front,
    occlusion_crops,
)
from directshape_torch.observation.regions import MASK_THRESHOLD
from directshape_torch.observation.sampling import PixelSelection
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.visualize.drawing import Picture, picture_of

GREEN, RED, YELLOW, BLUE = (0, 230, 0), (255, 40, 40), (255, 220, 0), (70, 130, 255)
OCCLUDER_COLOURS = ((255, 120, 0), (200, 60, 255), (0, 200, 200), (255, 80, 160), (150, 200, 0))
PANEL_GAP_PX = 6


def sampling_picture(
    frames: FrameBatch,
    detections: Detections,
    regions: Tensor,  # (B, 4)
    selection: PixelSelection,
    object_number: int,
    side: Side = "left",
    order: OcclusionOrder = "depth",
    scale: int = 4,
) -> Picture:
    """The visible pixels of one car: green above the threshold, red the strongest of cells without such a pixel.

    Args:
        frames, detections, regions, selection: what the selection was made from, all of the same side.
        object_number: the car.
        side: the image shown.
        order: order of the occluders.
        scale: picture pixels per image pixel.

    Returns:
        (h, w, 3) RGB uint8: the car's region, enlarged.

    Raises:
        InputError: no such car, or a car whose region is empty.
    """
    region = _region(regions, object_number)
    picture = _enlarged(_crop(frames, detections, object_number, side, region), scale)
    of_car = selection.object_index == object_number
    uv, above = selection.uv[of_car], selection.above_threshold[of_car]
    hidden = occlusion_crops(detections, side, regions, order).at(selection.object_index[of_car], uv)
    u0, v0 = region[:2]
    for (u, v), is_above in zip(uv[~hidden].tolist(), above[~hidden].tolist(), strict=True):
        centre = (round((u - u0 + 0.5) * scale), round((v - v0 + 0.5) * scale))
        cv2.circle(picture, centre, max(1, round(0.4 * scale)), GREEN if is_above else RED, -1, cv2.LINE_AA)
    return picture


def occlusion_picture(
    frames: FrameBatch,
    detections: Detections,
    regions: Tensor,  # (B, 4)
    object_number: int,
    side: Side = "left",
    order: OcclusionOrder = "depth",
    scale: int = 2,
) -> Picture:
    """Three panels of one car: the image with its region, the masks of car (blue) and occluders, the occlusion mask.

    Args:
        frames, detections: the scene.
        regions: (B, 4) integer regions of the cars in this image, half open.
        object_number: the car.
        side: the image shown.
        order: order of the occluders.
        scale: picture pixels per image pixel.

    Returns:
        (h, w, 3) RGB uint8, panels side by side.

    Raises:
        InputError: no such car, or a car whose region is empty.
    """
    region = _region(regions, object_number)
    view = _grown(region, frames.sizes[detections.frame_index[object_number]])
    image = _crop(frames, detections, object_number, side, view)
    mask = detections.mask_left if side == "left" else detections.mask_right
    coloured = _tinted(image, _array(mask[object_number] > MASK_THRESHOLD, view), BLUE)
    for rank, occluder in enumerate(_masks_in_front(detections, object_number, side, order)):
        colour = OCCLUDER_COLOURS[rank % len(OCCLUDER_COLOURS)]
        coloured = _tinted(coloured, _array(occluder > MASK_THRESHOLD, view), colour)

    hidden = occlusion_crops(detections, side, regions, order).crop(object_number).cpu().numpy()
    shown = np.zeros_like(image)
    u0, v0 = region[0] - view[0], region[1] - view[1]
    shown[v0 : v0 + hidden.shape[0], u0 : u0 + hidden.shape[1]] = hidden[..., None] * np.uint8(255)
    panels = [_with_frame(_enlarged(panel, scale), region, view, scale) for panel in (image, coloured, shown)]
    gap = np.full((panels[0].shape[0], PANEL_GAP_PX, 3), 255, np.uint8)
    return np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1)


def _region(regions: Tensor, object_number: int) -> tuple[int, int, int, int]:
    if not 0 <= object_number < len(regions):
        raise InputError("object_number", f"0..{len(regions) - 1}", f"{object_number}")
    u0, v0, u1, v1 = (int(edge) for edge in regions[object_number])
    if u1 <= u0 or v1 <= v0:
        raise InputError("regions", f"a region with pixels for car {object_number}", f"{(u0, v0, u1, v1)}")
    return u0, v0, u1, v1


def _grown(region: tuple[int, int, int, int], size: Tensor) -> tuple[int, int, int, int]:
    """A little of the surroundings, so that the region's frame is seen."""
    u0, v0, u1, v1 = region
    height, width = (int(length) for length in size)
    margin = 8 + (u1 - u0) // 6
    return max(u0 - margin, 0), max(v0 - margin, 0), min(u1 + margin, width), min(v1 + margin, height)


def _crop(
    frames: FrameBatch, detections: Detections, object_number: int, side: Side, region: tuple[int, int, int, int]
) -> Picture:
    images = frames.images_left if side == "left" else frames.images_right
    u0, v0, u1, v1 = region
    return picture_of(images[int(detections.frame_index[object_number]), :, v0:v1, u0:u1])


def _masks_in_front(detections: Detections, object_number: int, side: Side, order: OcclusionOrder) -> list[Tensor]:
    numbers = instances_in_front(detections, side, order)[:, object_number].nonzero()[:, 0].tolist()
    own = detections.mask_left if side == "left" else detections.mask_right
    others = detections.occluders
    masks = []
    for number in numbers:
        if number < len(detections):
            masks.append(own[number])
        elif others is not None:
            masks.append((others.mask_left if side == "left" else others.mask_right)[number - len(detections)])
    return masks


def _array(mask: Tensor, view: tuple[int, int, int, int]) -> npt.NDArray[np.bool_]:
    u0, v0, u1, v1 = view
    cropped: npt.NDArray[np.bool_] = mask[v0:v1, u0:u1].cpu().numpy()
    return cropped


def _tinted(image: Picture, mask: npt.NDArray[np.bool_], colour: tuple[int, int, int]) -> Picture:
    tinted = image.copy()
    tinted[mask] = (0.45 * image[mask] + 0.55 * np.array(colour)).astype(np.uint8)
    return tinted


def _enlarged(image: Picture, scale: int) -> Picture:
    return image.repeat(scale, axis=0).repeat(scale, axis=1)


def _with_frame(
    panel: Picture, region: tuple[int, int, int, int], view: tuple[int, int, int, int], scale: int
) -> Picture:
    u0, v0, u1, v1 = region
    first = ((u0 - view[0]) * scale, (v0 - view[1]) * scale)
    last = ((u1 - view[0]) * scale - 1, (v1 - view[1]) * scale - 1)
    cv2.rectangle(panel, first, last, YELLOW, max(1, scale))
    return panel
