"""How far two residual disparity fields of one rig are apart, where both have data."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField, nearest_in_convex_polygon

_SPACING_PX = 8


@dataclass(frozen=True)
class FieldDifference:
    """First minus second field over a grid of pixels inside of both hulls.

    Attributes:
        share_of_image: that lies in both hulls.
        mean_px, rms_px, largest_px: of the disparity bias; the last is absolute.
        rows_rms_px: of the vertical part.
    """

    share_of_image: float
    mean_px: float
    rms_px: float
    largest_px: float
    rows_rms_px: float

    def __str__(self) -> str:
        return (
            f"mean {self.mean_px:+.3f}, RMS {self.rms_px:.3f}, at most {self.largest_px:.3f} px; "
            f"rows RMS {self.rows_rms_px:.3f} px; over {100 * self.share_of_image:.0f} % of the image"
        )


def compare_fields(first: DisparityField, second: DisparityField) -> FieldDifference:
    """Compare two fields of the same images and calibration inside of both hulls.

    Raises:
        InputError: they belong to different rigs, or their hulls have nothing in common.

    Examples:
        >>> K, T = torch.eye(3), torch.eye(4)
        >>> a, b = (DisparityField.constant(value, (640, 480), K, K, T) for value in (0.25, 0.0))
        >>> compare_fields(a, b).rms_px
        0.25
    """
    first.check_rig(second.size_wh, second.K_left, second.K_right, second.T_right_cam)
    uv = _grid(first.size_wh)
    common = _inside(uv, first) & _inside(uv, second)
    if not bool(common.any()):
        raise InputError("fields", "hulls with a common part", "none", "fit the fields to more of the image")
    inside = uv[common]
    of_both = zip(first.offsets(inside), second.offsets(inside), strict=True)
    difference, of_rows = (one - other for one, other in of_both)
    return FieldDifference(
        float(common.double().mean()),
        float(difference.mean()),
        float(difference.square().mean().sqrt()),
        float(difference.abs().max()),
        float(of_rows.square().mean().sqrt()),
    )


def _grid(size_wh: tuple[int, int]) -> Tensor:
    u, v = (torch.arange(0, n, _SPACING_PX, dtype=torch.float64) for n in size_wh)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)


def _inside(uv: Tensor, field: DisparityField) -> Tensor:
    return (nearest_in_convex_polygon(uv, field.hull_uv.double()) == uv).all(dim=-1)
