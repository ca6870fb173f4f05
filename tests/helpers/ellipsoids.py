"""This module has ellipsoids as a field with known geometry, and as a small prior whose code changes the half axes."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.shape.shape_prior import SdfDerivatives

CENTRE_OBJ = (0.0, -0.75, 0.0)
HALF_AXES = (1.95, 0.75, 0.8)
AXES_STD_M = 0.12


class Ellipsoid:
    """An `Ellipsoid` is the field `scale (|(X - centre) / half_axes| - 1)`, a `BoundShape` without code.

    Its zero level is exact. With equal half axes `radius` and `scale = radius` it is the true distance to a sphere.
    """

    def __init__(self, half_axes: Tensor, centre: Tensor, scale: float) -> None:
        self.half_axes, self.centre, self.scale = half_axes, centre, scale

    @classmethod
    def sphere(cls, radius: float, dtype: torch.dtype = torch.float64) -> Ellipsoid:
        return cls(torch.full((3,), radius, dtype=dtype), torch.zeros(3, dtype=dtype), radius)

    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        return self.scale * (((points_obj - self.centre) / self.half_axes).norm(dim=-1) - 1)

    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        scaled = (points_obj - self.centre) / self.half_axes
        length = scaled.norm(dim=-1)
        gradient = self.scale * scaled / (length[:, None] * self.half_axes)
        return SdfDerivatives(self.value(points_obj, object_index), gradient, points_obj.new_zeros(len(points_obj), 0))

    @property
    def bounds(self) -> Tensor:
        return torch.stack([self.centre - 1.4 * self.half_axes, self.centre + 1.4 * self.half_axes])


def _distance(points: Tensor, half_axes: Tensor) -> Tensor:
    """Distance to an ellipsoid, exact at the surface and correct to first order near it."""
    level = (points / half_axes).norm(dim=-1).clamp_min(1e-3)
    slope = (points / half_axes**2).norm(dim=-1).clamp_min(1e-3)
    return level * (level - 1) / slope


def ellipsoid_prior(dtype: torch.dtype = torch.float64, num_codes: int = 3, spacing_m: float = 0.2) -> PCAShapePrior:
    """A prior of ellipsoids on the ground; code k changes half axis k (length, height, width) by about 0.12 m."""
    lower = torch.tensor([-2.8, -2.2, -1.6], dtype=torch.float64)
    upper = torch.tensor([2.8, 0.8, 1.6], dtype=torch.float64)
    counts = ((upper - lower) / spacing_m).round().long() + 1
    axes = [lower[i] + spacing_m * torch.arange(int(counts[i]), dtype=torch.float64) for i in range(3)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1) - torch.tensor(CENTRE_OBJ, dtype=torch.float64)
    half_axes = torch.tensor(HALF_AXES, dtype=torch.float64)
    basis = []
    for k in range(num_codes):
        stretch = AXES_STD_M * torch.eye(3, dtype=torch.float64)[k]
        basis.append((_distance(points, half_axes + stretch) - _distance(points, half_axes - stretch)) / 2)
    dimensions_basis = 2 * AXES_STD_M * torch.eye(3, dtype=torch.float64)[[1, 2, 0], :num_codes]
    dimensions = 2 * half_axes[[1, 2, 0]]
    return PCAShapePrior(
        _distance(points, half_axes),
        torch.stack(basis, dim=-1),
        lower,
        spacing_m,
        explained_variance_ratio=torch.full((num_codes,), 1 / num_codes, dtype=torch.float64),
        dimensions_mean_hwl=dimensions,
        dimensions_basis_hwl=dimensions_basis,
        dimensions_std_hwl=torch.full((3,), 2 * AXES_STD_M, dtype=torch.float64),
        provenance=PriorProvenance("tests", "Apache-2.0", 0),
    ).to(dtype)
