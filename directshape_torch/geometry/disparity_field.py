"""placeholder: contract only, filled in next."""
from __future__ import annotations
import torch
from torch import Tensor


class DisparityField:
    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> DisparityField:
        raise NotImplementedError

    def bias(self, uv_left: Tensor) -> Tensor:
        raise NotImplementedError

    def check_rig(self, size_wh: tuple[int, int], K_left: Tensor, K_right: Tensor, T_right_cam: Tensor) -> None:
        raise NotImplementedError
