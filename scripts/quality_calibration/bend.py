"""Smooth errors of a stereo rig, put into right images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.disparity_field import EXPONENTS, NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.masks import MaskCrops
from directshape_torch.scene import Detections, FrameBatch


@dataclass(frozen=True)
class Bend:
    """By how much disparities and rows of a right image are larger than true ones, as lenses bend it."""

    coefficients: Tensor  # (10, 2) pixels, of disparity and row, polynomials over the right image
    size_wh: tuple[int, int]  # of the image

    @classmethod
    def drawn(cls, largest_px: float, rows_px: float, size_wh: tuple[int, int], seed: int) -> Bend:
        """Random coefficients, smaller for higher degrees, scaled to the largest values within the image."""
        generator = torch.Generator().manual_seed(seed)
        shrinking = torch.tensor([0.7 ** (i + j) for i, j in EXPONENTS], dtype=torch.float64)
        drawn = torch.randn(NUM_COEFFICIENTS, 2, generator=generator, dtype=torch.float64) * shrinking[:, None]
        largest = (polynomial_basis(_pixels(size_wh), size_wh) @ drawn).abs().amax(dim=0)
        return cls(drawn * torch.tensor([largest_px, rows_px], dtype=torch.float64) / largest, size_wh)

    def image(self, image: NDArray[Any], interpolation: int = cv2.INTER_LANCZOS4) -> NDArray[Any]:
        """A right image (H, W) or (H, W, 3) as this rig would show it."""
        return cv2.remap(image, *self._maps, interpolation, borderMode=cv2.BORDER_REPLICATE)

    def frames(self, frames: FrameBatch) -> FrameBatch:
        """One frame as this rig would show it."""
        image = (255 * frames.images_right[0]).round().byte().permute(1, 2, 0).numpy()
        bent = torch.from_numpy(self.image(image)).permute(2, 0, 1)[None]
        return replace(frames, images_right=bent.to(frames.images_right) / 255)

    def masks(self, detections: Detections) -> Detections:
        """Detections whose right masks follow the image."""
        masks = [torch.from_numpy(self.image(mask.numpy(), cv2.INTER_LINEAR)) for mask in detections.mask_right]
        return replace(detections, mask_right=MaskCrops.of(masks)) if masks else detections

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        width, height = self.size_wh
        uv = _pixels(self.size_wh)
        disparity, row = (polynomial_basis(uv, self.size_wh) @ self.coefficients).unbind(dim=1)
        # The disparity u - x of a pixel x is larger by f where x shows what belongs to x + f.
        maps = uv[:, 0] + disparity, uv[:, 1] - row
        from_u, from_v = (m.view(height, width).numpy().astype(np.float32) for m in maps)
        return from_u, from_v


def _pixels(size_wh: tuple[int, int]) -> Tensor:
    width, height = size_wh
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return torch.stack([u, v], dim=-1).view(-1, 2)
