"""Right images whose exposure is off by a known amount, as no two cameras agree in full."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.stereo_dataset import LoadedFrame
from paper_tables.settings import Exposure


class ExposedDataset(KittiStereoDataset):
    """A data set whose right images are seen through another camera; the rest is as in `KittiStereoDataset`."""

    def __init__(self, *args: Any, exposure: Exposure = "true", **options: Any) -> None:
        super().__init__(*args, **options)
        self.exposure = exposure

    def load(self, frame_id: str) -> LoadedFrame:
        loaded = super().load(frame_id)
        if self.exposure == "true":
            return loaded
        frame = loaded.frame
        return replace(loaded, frame=replace(frame, images_right=exposed(frame.images_right, self.exposure)))


def exposed(images: Tensor, exposure: Exposure) -> Tensor:
    """Images (F, 3, H, W) in [0, 1] with other brightness, in bytes as a camera gives them.

    Examples:
        >>> (255 * exposed(torch.full((1, 3, 1, 1), 100 / 255), "flatter")[0, 0]).round()
        tensor([[105.]])
    """
    return (255 * _CHANGES[exposure](images)).round().clamp(0, 255) / 255


def _vignetted(images: Tensor) -> Tensor:
    share = torch.linspace(0, 1, images.shape[-1], dtype=images.dtype, device=images.device)
    return images * (1 - 0.35 * share)


_CHANGES: dict[Exposure, Callable[[Tensor], Tensor]] = {
    "true": lambda x: x,
    "flatter": lambda x: 0.8 * x + 25 / 255,
    "vignetted": _vignetted,
}
