"""Kernel PCA of signed distance grids as a shape prior: a curved family of shapes with a whitened code.

Codes are the leading kernel principal components of the training cars (Schoelkopf, Smola, Mueller 1998). The way back
from a code to a shape, the pre-image, is learned by kernel ridge regression (Bakir, Weston, Schoelkopf 2004) and ends
in a linear subspace of grids, so that binding a car costs about what it does with PCA. Only the derivative by the code
differs: it depends on the code.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_alike, check_shape
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.shape.pca_fit import fit_pca, training_codes
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance, read_prior, write_prior
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import DimensionsDerivative, SdfDerivatives

_CURE = "make one with: python scripts/build_bundled_prior.py --kernel 32 --out FILE"
# Of the Gaussian kernel between cars, in units of their root mean square distance.
_FEATURE_WIDTH = 4.0
_GRIDS = ("subspace.mean", "subspace.basis")


class KernelPCAShapePrior(nn.Module):
    """`sdf(X; code) = mean(X) + sum_m c_m(code) basis_m(X)`, c a kernel expansion; implements `ShapePrior`.

    `c(code) = offset + linear code + sum_i weights_i exp(-|code - anchor_i|^2 / (2 width^2))`.

    Args:
        subspace: linear prior of M components that holds the grids; its own code is c, its provenance this prior's.
        anchors: codes of the N training cars, (N, K), standard deviations.
        weights: of the kernels, (N, M).
        linear: (M, K).
        offset: (M,).
        dimensions_basis_hwl: change of the dimensions by c, (3, M), metres.
        kernel_width: (), in standard deviations of the code.

    Raises:
        InputError: shapes that do not fit together, or a width that is not positive.

    Examples:
        >>> x = torch.linspace(-1, 1, 9)
        >>> radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1)
        >>> balls = torch.stack([radius - r for r in torch.linspace(0.4, 0.7, 7)])
        >>> made = PriorProvenance("an example", "Apache-2.0", 7)
        >>> prior = KernelPCAShapePrior.fit(balls, torch.full((3,), -1.0), 0.25, 1, made, num_components=2)
        >>> at = prior.bind(prior.initial_code(1)).value_and_derivatives(torch.zeros(1, 3), torch.tensor([0]))
        >>> at.J_value_code.shape
        torch.Size([1, 1])
    """

    SCHEMA: ClassVar = "directshape_torch.kernel_pca_shape_prior/1"

    anchors: Tensor
    weights: Tensor
    linear: Tensor
    offset: Tensor
    kernel_width: Tensor

    def __init__(
        self,
        subspace: PCAShapePrior,
        *,
        anchors: Tensor,
        weights: Tensor,
        linear: Tensor,
        offset: Tensor,
        kernel_width: Tensor,
    ) -> None:
        super().__init__()
        check_shape("anchors", anchors, ("N", "K"))
        check_shape("weights", weights, (len(anchors), subspace.num_codes))
        check_shape("linear", linear, (subspace.num_codes, anchors.shape[1]))
        check_shape("offset", offset, (subspace.num_codes,))
        check_shape("kernel_width", kernel_width, ())
        if not bool(kernel_width.isfinite() & (kernel_width > 0)):
            raise InputError("kernel_width", "a positive number of standard deviations", f"{kernel_width}")
        self.subspace = subspace
        self.register_buffer("anchors", anchors)
        self.register_buffer("weights", weights)
        self.register_buffer("linear", linear)
        self.register_buffer("offset", offset)
        self.register_buffer("kernel_width", kernel_width)

    @property
    def provenance(self) -> PriorProvenance:
        return self.subspace.provenance

    @property
    def num_codes(self) -> int:
        return self.anchors.shape[1]

    @property
    def bounds_obj(self) -> Tensor:
        """Lower and upper corner of the grid, (2, 3), metres."""
        return self.subspace.bounds_obj

    @property
    def origin(self) -> Tensor:
        return self.subspace.origin

    @property
    def spacing_m(self) -> float:
        return self.subspace.spacing_m

    def initial_code(self, num_objects: int) -> Tensor:
        """Codes of the mean of the training cars, (B, K) zeros."""
        return self.anchors.new_zeros(num_objects, self.num_codes)

    @in_full_precision
    def coefficients(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates c (B, M) in the subspace for codes (B, K), and `J_c_code` (B, M, K)."""
        check_shape("code", code, ("B", self.num_codes))
        check_alike("code", code, "the prior", self.anchors)
        difference = code[:, None] - self.anchors  # (B, N, K)
        kernel = torch.exp(-0.5 * (difference * difference).sum(-1) / self.kernel_width**2)
        c = self.offset + code @ self.linear.T + kernel @ self.weights
        J_kernel_code = -kernel[..., None] * difference / self.kernel_width**2
        return c, self.linear + torch.einsum("nm,bnk->bmk", self.weights, J_kernel_code)

    def bind(self, code: Tensor) -> CurvedGridShape:
        """The fields of B objects with codes (B, K): one grid per object, and how it moves through the subspace."""
        c, J_c_code = self.coefficients(code)
        return CurvedGridShape(self.subspace.bind(c), J_c_code)

    def values(self, code: Tensor) -> Tensor:
        """Signed distance at the nodes, (B, nx, ny, nz), metres, for codes (B, K)."""
        return self.subspace.values(self.coefficients(code)[0])

    @in_full_precision
    def dimensions_and_derivative(self, code: Tensor) -> DimensionsDerivative:
        """Height, width and length (B, 3), metres, linear in the subspace and so curved in the code."""
        c, J_c_code = self.coefficients(code)
        at = self.subspace.dimensions_and_derivative(c)
        return DimensionsDerivative(at.hwl, at.J_hwl_code @ J_c_code)

    @classmethod
    @in_full_precision
    def fit(
        cls,
        sdf_samples: Tensor,  # (N, nx, ny, nz)
        origin: Tensor,  # (3,)
        spacing_m: float,
        num_codes: int,
        provenance: PriorProvenance,
        num_components: int = 32,
        kernel_width: float = 4.0,
        ridge: float = 1.0,
    ) -> KernelPCAShapePrior:
        """Kernel principal components of N signed distance grids and the regression back to grids.

        Args:
            sdf_samples, origin, spacing_m, provenance: as for `fit_pca`.
            num_codes: K kernel principal components.
            num_components: M linear components that hold the grids, num_codes <= M < N.
            kernel_width: of the kernels of the pre-image, in standard deviations of the code.
            ridge: regularisation of the pre-image; larger is smoother.

        Raises:
            InputError: fewer components than codes, too few samples, or non-finite ones.
        """
        if num_components < num_codes:
            raise InputError("num_components", f"at least num_codes = {num_codes}", f"{num_components}")
        subspace = fit_pca(sdf_samples, origin, spacing_m, num_components, provenance).double()
        coordinates = training_codes(sdf_samples, num_components)  # (N, M), variance 1 each
        scale = subspace.explained_variance_ratio.sqrt()
        anchors = _kernel_components(coordinates * scale, num_codes)
        offset, linear, weights = _ridge_regression(anchors, coordinates, kernel_width, ridge)
        width = anchors.new_tensor(kernel_width)
        fitted = cls(subspace, anchors=anchors, weights=weights, linear=linear, offset=offset, kernel_width=width)
        return fitted.to(sdf_samples.dtype)

    def save(self, path: Path | str) -> None:
        """Write a safetensors file, atomically; the grids in float16, which rounds by less than 1 mm near surfaces."""
        tensors = dict(self.named_buffers())
        tensors |= {name: tensors[name].to(torch.float16) for name in _GRIDS}
        write_prior(path, self.SCHEMA, self.provenance, tensors, spacing_m=self.spacing_m)

    @classmethod
    def load(cls, path: Path | str) -> KernelPCAShapePrior:
        """Read a file of `save`, float32 on the CPU; raises as `PCAShapePrior.load`."""

        def make(tensors: dict[str, Tensor], made: PriorProvenance, settings: dict[str, Any]) -> KernelPCAShapePrior:
            of_subspace = {name.removeprefix("subspace."): tensors.pop(name) for name in list(tensors) if "." in name}
            subspace = PCAShapePrior(spacing_m=float(settings["spacing_m"]), provenance=made, **of_subspace)
            return cls(subspace, **tensors)

        return read_prior(path, cls.SCHEMA, _CURE, make)


class CurvedGridShape:
    """Fields of B objects in a linear subspace of grids whose coordinates depend on the code (a `BoundShape`)."""

    def __init__(
        self,
        grid: GridShape,  # whose "code" is the coordinates c
        J_c_code: Tensor,  # (B, M, K)
    ) -> None:
        self._grid, self._J_c_code = grid, J_c_code

    @in_full_precision
    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """Signed distance (P,) in metres at points (P, 3) of objects (P,)."""
        return self._grid.value(points_obj, object_index)

    @in_full_precision
    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        """Value (P,), gradient (P, 3) and code derivative `J_value_c J_c_code` (P, K)."""
        at = self._grid.value_and_derivatives(points_obj, object_index)
        J_value_code = (at.J_value_code[:, None] @ self._J_c_code[object_index])[:, 0]
        return SdfDerivatives(at.value, at.gradient, J_value_code)


def _kernel_components(coordinates: Tensor, num_codes: int) -> Tensor:
    """Leading kernel principal components (N, K) of the samples (N, M), mean 0 and variance 1 each."""
    width = _FEATURE_WIDTH * float((torch.cdist(coordinates, coordinates) ** 2).mean().sqrt())
    kernel = _gaussian(coordinates, coordinates, width)
    centred = kernel - kernel.mean(0) - kernel.mean(1, keepdim=True) + kernel.mean()
    vectors = torch.linalg.eigh(centred).eigenvectors.flip(1)[:, :num_codes]
    # A component's sign is free: let it go with the linear component that it resembles most.
    likeness = vectors.T @ coordinates
    best = likeness.abs().argmax(dim=1, keepdim=True)
    aligned: Tensor = vectors * likeness.gather(1, best).sign().T * (len(coordinates) - 1) ** 0.5
    return aligned


def _gaussian(a: Tensor, b: Tensor, width: float | Tensor) -> Tensor:
    return torch.exp(-0.5 * torch.cdist(a, b) ** 2 / width**2)


def _ridge_regression(
    anchors: Tensor, targets: Tensor, kernel_width: float, ridge: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Offset (M,), linear part (M, K) and kernel weights (N, M): least squares first, kernels for what it leaves."""
    design = torch.cat([torch.ones_like(anchors[:, :1]), anchors], dim=1)
    solution = torch.linalg.lstsq(design, targets).solution
    kernel = _gaussian(anchors, anchors, kernel_width)
    penalised = kernel + ridge * torch.eye(len(anchors), dtype=kernel.dtype, device=kernel.device)
    weights = torch.linalg.solve(penalised, targets - design @ solution)
    return solution[0], solution[1:].T, weights
