"""The sampled pixels of a car in both images, two rounds in two colours, and what hides it (paper, both figures)."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.figure_files import new_figure
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.observation.occlusion import Side, occlusion_crops
from directshape_torch.observation.packing import car_regions
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.observation.sampling import sampling_settings, selected_pixels
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import draw_lines, show_crop, write_figure
from directshape_torch.visualize.sampling_picture import PANEL_GAP_PX, occlusion_picture

_PANEL_INCHES, _ROOM_INCHES = 6.0, 0.8
_STRONG_INK, _FILL_INK, _EVEN_INK = "lime", "red", "yellow"
# Of the region of a far car in the occlusion picture.
_LEAST_HEIGHT_PX = 180


class SampledPixels(NamedTuple):
    """Pixels of one car in one image that its terms look at."""

    uv: NDArray[np.int64]  # (P, 2)
    above_threshold: NDArray[np.bool_]  # (P,) chosen for a strong gradient, not to fill its cell
    num_hidden: int  # chosen pixels that a nearer instance hides: they are left out
    by_gradient: bool  # chosen by their gradients at all

    @property
    def groups(self) -> list[tuple[NDArray[np.bool_], str, str]]:
        """Which (P,) belong together, with their ink and name."""
        strong = self.above_threshold
        if not self.by_gradient:
            return [(np.ones_like(strong), _EVEN_INK, "whatever the gradient")]
        return [(strong, _STRONG_INK, "strong gradient"), (~strong, _FILL_INK, "strongest of cell")]

    @property
    def in_words(self) -> str:
        """How many there are, and why."""
        strong = int(self.above_threshold.sum())
        by_gradient = f"{strong} by their gradient, {len(self.uv) - strong} to fill cells"
        chosen = by_gradient if self.by_gradient else f"{len(self.uv)} whatever their gradient"
        return f"{chosen}, {self.num_hidden} hidden"


def sampled_pixels(view: CarView, side: Side) -> SampledPixels:
    """The pixels as the refinement chose them, with the round that each comes from."""
    config = view.trace.config.sampling
    frames, detections = view.loaded.frame, without_empty_masks(view.loaded.detections)
    left, right = car_regions(frames, detections)
    images, regions = (frames.images_left, left) if side == "left" else (frames.images_right, right)
    settings = sampling_settings(config, side)
    chosen = selected_pixels(images, frames.sizes, detections.frame_index, regions, settings)
    mine = chosen.object_index == view.car
    uv, above = chosen.uv[mine], chosen.above_threshold[mine]
    hidden = occlusion_crops(detections, side, regions, config.occlusion_order).at(chosen.object_index[mine], uv)
    kept = ~hidden if config.occlusion else torch.ones_like(hidden)
    by_gradient = settings.mode in ("adaptive", "round_one")
    return SampledPixels(np.asarray(uv[kept].cpu()), np.asarray(above[kept].cpu()), int((~kept).sum()), by_gradient)


def write_sampling_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG, both images side by side.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(2 * _PANEL_INCHES, _PANEL_INCHES * view.panel_aspect() + _ROOM_INCHES, "drawing sampled pixels")
    figure.suptitle(view.title)
    left, right = (sampled_pixels(view, side) for side in SIDES)
    for axes, side, pixels in zip(figure.subplots(1, 2), SIDES, (left, right), strict=True):
        show_crop(axes, view.image(side), view.window(side), f"{side}: {pixels.in_words}")
        draw_lines(axes, view.mask_lines(side), "white", "mask", linewidth=1.0)
        for chosen, ink, name in pixels.groups:
            axes.plot(*pixels.uv[chosen].T, ".", color=ink, markersize=4, label=name)
        # One for both where they have the same colours.
        if side == "right" or left.by_gradient != right.by_gradient:
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
