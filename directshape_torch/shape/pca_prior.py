"""Principal components of signed distance grids make a shape prior with a whitened code (paper, section on shape)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_alike, check_finite, check_positive, check_shape
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.shape.prior_file import PriorProvenance, read_prior, write_prior
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import DimensionsDerivative

_CURE = "make one with: directshape build-prior"


class PCAShapePrior(nn.Module):
    """This `ShapePrior` is `sdf(X; code) = mean(X) + sum_k code_k basis_k(X)`, trilinear on a grid.

    Args:
        mean: signed distance of the mean shape, (nx, ny, nz), metres, negative inside.
        basis: (nx, ny, nz, K), metres per standard deviation of the code (sigma is folded in).
        origin: node (0, 0, 0) in the object frame (x forward, y down, ground at y = 0), (3,), metres.
        spacing_m: distance between nodes, the same along all axes.
        explained_variance_ratio: share of the training variance that each component explains, (K,).
        dimensions_mean_hwl: height, width, length of the mean car, (3,), metres.
        dimensions_basis_hwl: linear change of the dimensions by the code, (3, K), metres per standard deviation.
        dimensions_std_hwl: standard deviation of the dimensions among the training cars, (3,), metres.
        provenance: where the prior comes from.

    Raises:
        InputError: shapes, dtypes or devices that do not fit together, numbers that are not finite, or a spacing that
            is not positive.

    Examples:
        >>> prior = PCAShapePrior.load_bundled()
        >>> code = prior.initial_code(2)
        >>> prior.values(code).shape[0], prior.bind(code).value(torch.zeros(1, 3), torch.tensor([1])).shape
        (2, torch.Size([1]))
    """

    SCHEMA: ClassVar = "directshape_torch.pca_shape_prior/2"

    mean: Tensor
    basis: Tensor
    origin: Tensor
    explained_variance_ratio: Tensor
    dimensions_mean_hwl: Tensor
    dimensions_basis_hwl: Tensor
    dimensions_std_hwl: Tensor

    def __init__(
        self,
        mean: Tensor,
        basis: Tensor,
        origin: Tensor,
        spacing_m: float,
        *,
        explained_variance_ratio: Tensor,
        dimensions_mean_hwl: Tensor,
        dimensions_basis_hwl: Tensor,
        dimensions_std_hwl: Tensor,
        provenance: PriorProvenance,
    ) -> None:
        super().__init__()
        check_shape("mean", mean, ("nx", "ny", "nz"), kind="floating")
        if min(mean.shape) < 2:
            raise InputError("mean", "at least two nodes along each axis", str(tuple(mean.shape)))
        check_shape("basis", basis, (*mean.shape, "K"), kind="floating")
        num_codes = basis.shape[-1]
        tensors = {
            "mean": (mean, mean.shape),
            "basis": (basis, basis.shape),
            "origin": (origin, (3,)),
            "explained_variance_ratio": (explained_variance_ratio, (num_codes,)),
            "dimensions_mean_hwl": (dimensions_mean_hwl, (3,)),
            "dimensions_basis_hwl": (dimensions_basis_hwl, (3, num_codes)),
            "dimensions_std_hwl": (dimensions_std_hwl, (3,)),
        }
        for name, (tensor, shape) in tensors.items():
            check_shape(name, tensor, shape, kind="floating")
            check_alike(name, tensor, "mean", mean)
            check_finite(name, tensor)
            self.register_buffer(name, tensor)
        check_positive("spacing_m", spacing_m)
        self.spacing_m = float(spacing_m)
        self.provenance = provenance

    @property
    def num_codes(self) -> int:
        return self.basis.shape[-1]

    @property
    def bounds_obj(self) -> Tensor:
        """Lower and upper corner of the grid, (2, 3), metres."""
        last_node = constant_like(tuple(self.mean.shape), self.origin) - 1
        return torch.stack([self.origin, self.origin + self.spacing_m * last_node])

    def initial_code(self, num_objects: int) -> Tensor:
        """Codes of the mean shape, (B, K) zeros."""
        return self.mean.new_zeros(num_objects, self.num_codes)

    @in_full_precision
    def values(self, code: Tensor) -> Tensor:
        """Signed distance at the nodes, (B, nx, ny, nz), metres, for codes (B, K)."""
        check_shape("code", code, ("B", self.num_codes))
        check_alike("code", code, "the prior", self.mean)
        flat = torch.addmm(self.mean.reshape(1, -1), code, self.basis.reshape(-1, self.num_codes).T)
        return flat.reshape(-1, *self.mean.shape)

    def bind(self, code: Tensor) -> GridShape:
        """The fields of B objects with codes (B, K): the basis is summed up into one grid for each object."""
        return GridShape.of(self.values(code), self.basis, self.origin, self.spacing_m)

    def unfilled(self, num_objects: int) -> GridShape:
        """The fields of B objects, whose distances at the nodes are still to be written."""
        values = self.mean.new_empty(num_objects, *self.mean.shape)
        return GridShape.of(values, self.basis, self.origin, self.spacing_m)

    @in_full_precision
    def dimensions_and_derivative(self, code: Tensor) -> DimensionsDerivative:
        """Height, width and length (B, 3), metres, by a linear map fitted to training cars, and their derivative."""
        check_shape("code", code, ("B", self.num_codes))
        check_alike("code", code, "the prior", self.mean)
        hwl = self.dimensions_mean_hwl + code @ self.dimensions_basis_hwl.T
        return DimensionsDerivative(hwl, self.dimensions_basis_hwl.expand(len(code), -1, -1))

    def save(self, path: Path | str, grid_dtype: torch.dtype = torch.float32) -> None:
        """Write a safetensors file, atomically; grids in `torch.float16` halve it and round by less than 1 mm.

        Raises:
            InputError: `grid_dtype` is neither `torch.float16` nor `torch.float32`.
        """
        if grid_dtype not in (torch.float16, torch.float32):
            raise InputError("grid_dtype", "torch.float16 or torch.float32", repr(grid_dtype))
        tensors = {name: tensor.to(torch.float32) for name, tensor in self.named_buffers()}
        tensors |= {name: tensors[name].to(grid_dtype) for name in ("mean", "basis")}
        write_prior(path, self.SCHEMA, self.provenance, tensors, spacing_m=self.spacing_m)

    @classmethod
    def load(cls, path: Path | str) -> PCAShapePrior:
        """Read a file that `save` wrote, as float32 on the CPU.

        Raises:
            DataFormatError: the file is missing, truncated or of another schema, or its tensors do not fit together.
        """

        def make(tensors: dict[str, Tensor], provenance: PriorProvenance, settings: dict[str, Any]) -> PCAShapePrior:
            return cls(spacing_m=float(settings["spacing_m"]), provenance=provenance, **tensors)

        return read_prior(path, cls.SCHEMA, _CURE, make)

    @classmethod
    def load_bundled(cls) -> PCAShapePrior:
        """The prior of passenger cars in the package (made of parametric cars; licence of this project)."""
        return cls.load(Path(__file__).parents[1] / "assets" / "car_prior.safetensors")

    def get_extra_state(self) -> Tensor:
        return torch.tensor(self.spacing_m, dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        self.spacing_m = float(state)
