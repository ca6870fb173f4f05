"""What a stage fixes for the photometric term: the images of a pyramid level and the pixel set with its left side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.geometry.short_axes import all_along
from directshape_torch.image.pyramid import halve, halve_sizes
from directshape_torch.residuals.photometric_profile import WarpLines
from directshape_torch.solver.normal_equations import Segments


@dataclass(frozen=True)
class GreyPair:
    """Grey levels of both images at one pyramid level."""

    left: Tensor  # (F, H, W)
    right: Tensor  # (F, H, W)
    sizes: Tensor  # (F, 2)
    scale: float  # level pixels per full-resolution pixel

    def halved(self) -> GreyPair:
        left, right = (halve(image[:, None])[:, 0] for image in (self.left, self.right))
        return GreyPair(left, right, halve_sizes(self.sizes), 0.5 * self.scale)


class PixelSet(NamedTuple):
    """The Q pixels of a stage, those of a car side by side, with N neighbourhood pixels each."""

    pixel_index: Tensor  # (Q,) rows of the packed left pixels, ascending
    object_index: Tensor  # (Q,)
    intensity_left: Tensor  # (Q, N) brought to the brightness of the right image, as far as the settings say
    rays_left: Tensor  # (Q, N, 3)
    lines: WarpLines  # where they land in the right image, at the level of `images`
    gradient_weight: Tensor  # (Q,)
    neighbour_weight: Tensor  # (Q, N) zero for neighbours that the mask says are not on the car
    images: GreyPair
    segments: Segments

    def select(self, chosen: Tensor, pixel_index: Tensor, object_index: Tensor, num_objects: int) -> PixelSet:
        """Some of the pixels.

        Args:
            chosen: (R,) rows of the set, ascending.
            pixel_index: (R,) rows of the packed left pixels as they are then.
            object_index: (R,) numbers of the cars as they are then, ascending.
            num_objects: cars then.
        """
        return PixelSet(
            pixel_index,
            object_index,
            self.intensity_left[chosen],
            self.rays_left[chosen],
            self.lines.select(chosen),
            self.gradient_weight[chosen],
            self.neighbour_weight[chosen],
            self.images,
            Segments.of_sorted(object_index, num_objects),
        )


def neighbours_on_car(
    mask_left: Tensor,  # (detections of the call, H, W)
    cars: CarBatch,
    sizes: Tensor,  # (F, 2) height, width of the frames
    object_index: Tensor,  # (Q,)
    uv: Tensor,  # (Q, N, 2) full-resolution pixels
) -> Tensor:
    """One (Q, N) for neighbours on the car, zero for those that the mask gives to something else.

    All neighbours are warped with the centre's depth: background beside the contour would pull the depth of a small
    car away from its surface.
    """
    last_of_frame = sizes[cars.frame_index[object_index]].flip(-1)[:, None] - 1
    inside = all_along((uv >= -0.5) & (uv <= last_of_frame + 0.5), dim=-1)
    u, v = uv.round().long().clamp_min(0).minimum(last_of_frame).unbind(-1)
    on_car = mask_left[cars.detection_row[object_index][:, None], v, u] > 0.5
    return (inside & on_car).to(uv.dtype)
