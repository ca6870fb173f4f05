"""The sampled pixels of a car in both images, and what hides it (paper, both figures)."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.config import SamplingMode
from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.figure_files import new_figure, write_figure
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.observation.occlusion import (
    OcclusionOrder,
    Side,
    instances_in_front,
    occlusion_map,
)
from directshape_torch.observation.packing import car_regions
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.observation.sampling import sampled_pixels
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.visualize.drawing import Picture, picture_of
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import draw_lines, show_crop

_PANEL_INCHES, _ROOM_INCHES = 6.0, 0.8
_INKS: dict[SamplingMode, str] = {"adaptive": "lime", "uniform": "yellow", "dense": "yellow"}
_CHOSEN: dict[SamplingMode, str] = {
    "adaptive": "by their gradient",
    "uniform": "evenly spaced",
    "dense": "of the whole region",
}
# Of the region of a far car in the occlusion picture.
_LEAST_HEIGHT_PX = 180


class SampledPixels(NamedTuple):
    """Pixels of one car in one image that its terms look at."""

    uv: NDArray[np.int64]  # (P, 2)
    num_hidden: int  # chosen pixels that a nearer instance hides: they are left out
    mode: SamplingMode

    @property
    def in_words(self) -> str:
        """How many there are, and why."""
        return f"{len(self.uv)} {_CHOSEN[self.mode]}, {self.num_hidden} hidden"


def sampled_pixels_of(view: CarView, side: Side) -> SampledPixels:
    """The pixels as the refinement chose them."""
    config = view.trace.config.sampling
    frames, detections = view.loaded.frame, without_empty_masks(view.loaded.detections)
    left, right = car_regions(frames, detections)
    images, regions, mode = (
        (frames.images_left, left, config.mode) if side == "left" else (frames.images_right, right, config.mode_right)
    )
    of, uv = sampled_pixels(images, frames.sizes, detections.frame_index, regions, mode, config)
    uv = uv[of == view.car]
    hidden = occlusion_map(detections, side, config.occlusion_order).at(torch.tensor(view.car).to(uv.device), uv)
    kept = ~hidden if config.occlusion else torch.ones_like(hidden)
    return SampledPixels(np.asarray(uv[kept].cpu()), int((~kept).sum()), mode)


def write_sampling_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG, both images side by side.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(2 * _PANEL_INCHES, _PANEL_INCHES * view.panel_aspect() + _ROOM_INCHES, "drawing sampled pixels")
    figure.suptitle(view.title)
    for axes, side in zip(figure.subplots(1, 2), SIDES, strict=True):
        pixels = sampled_pixels_of(view, side)
        show_crop(axes, view.image(side), view.window(side), f"{side}: {pixels.in_words}")
        draw_lines(axes, view.mask_lines(side), "white", "mask", linewidth=1.0)
        axes.plot(*pixels.uv.T, ".", color=_INKS[pixels.mode], markersize=4, label=_CHOSEN[pixels.mode])
        axes.legend(loc="lower right", fontsize=8, facecolor="0.3", labelcolor="white")
    write_figure(path, figure)


def write_occlusion_picture(path: Path | str, view: CarView) -> None:
    """Write, as PNG, image, masks and occlusion mask, the left image above the right one where it has a region too."""
    detections = without_empty_masks(view.loaded.detections)
    config = view.trace.config.sampling
    regions = car_regions(view.loaded.frame, detections)
    # One scale for both images, or the car would seem to change its size.
    scale = max(2, round(_LEAST_HEIGHT_PX / max(v1 - v0 for _, v0, _, v1 in view.regions)))
    rows = []
    for side, region in zip(SIDES, regions, strict=True):
        u0, v0, u1, v1 = region[view.car].tolist()
        if u1 > u0 and v1 > v0:
            order = config.occlusion_order
            rows.append(occlusion_picture(view.loaded.frame, detections, region, view.car, side, order, scale))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, PANEL_GAP_PX), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    write_png(path, np.concatenate(padded))


_REGION_COLOUR, _OWN_COLOUR = (255, 220, 0), (70, 130, 255)
OCCLUDER_COLOURS = ((255, 120, 0), (200, 60, 255), (0, 200, 200), (255, 80, 160), (150, 200, 0))
PANEL_GAP_PX = 6


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
    coloured = _tinted(image, _array(mask[object_number] > MASK_THRESHOLD, view), _OWN_COLOUR)
    for rank, occluder in enumerate(_masks_in_front(detections, object_number, side, order)):
        colour = OCCLUDER_COLOURS[rank % len(OCCLUDER_COLOURS)]
        coloured = _tinted(coloured, _array(occluder > MASK_THRESHOLD, view), colour)

    hidden = occlusion_map(detections, side, order).window(object_number, region).cpu().numpy()
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
    cv2.rectangle(panel, first, last, _REGION_COLOUR, max(1, scale))
    return panel
