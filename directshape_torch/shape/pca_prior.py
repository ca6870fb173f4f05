"""Principal components of signed distance grids as a shape prior with a whitened code (paper, section on the shape)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_alike, check_positive, check_shape, check_stored, check_type
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.shape.sdf_grid import GridShape, zero_level_extents
from directshape_torch.shape.shape_prior import DimensionsDerivative

# Codes within this many standard deviations of the mean are 'in use': the Lipschitz bound covers them.
CODE_NORM_IN_USE = 3.0
# Spread of the weight of grid nodes about the samples' surfaces.
_SURFACE_BAND_M = 0.2


@dataclass(frozen=True)
class PriorProvenance:
    """Where a prior comes from: kept inside its file."""

    made_by: str
    licence: str
    num_samples: int
    remarks: str = ""


class PCAShapePrior(nn.Module):
    """`sdf(X; code) = mean(X) + sum_k code_k basis_k(X)`, trilinear on a grid; implements `ShapePrior`.

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
            check_stored(name, tensor)
            if not bool(tensor.isfinite().all()):
                raise InputError(name, "finite numbers", "NaN or infinity")
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

    @property
    def lipschitz(self) -> float:
        """Bound of |gradient| on the grid over all codes of norm up to `CODE_NORM_IN_USE`."""
        return self.lipschitz_within(CODE_NORM_IN_USE)

    def lipschitz_within(self, code_norm: float) -> float:
        """Bound of |gradient| on the grid over all codes of norm up to `code_norm`."""
        return float(_gradient_bound(self.mean, self.basis, code_norm) / self.spacing_m)

    def initial_code(self, num_objects: int) -> Tensor:
        """Codes of the mean shape, (B, K) zeros."""
        return self.mean.new_zeros(num_objects, self.num_codes)

    def values(self, code: Tensor) -> Tensor:
        """Signed distance at the nodes, (B, nx, ny, nz), metres, for codes (B, K)."""
        check_shape("code", code, ("B", self.num_codes))
        flat = torch.addmm(self.mean.reshape(1, -1), code, self.basis.reshape(-1, self.num_codes).T)
        return flat.reshape(-1, *self.mean.shape)

    def bind(self, code: Tensor) -> GridShape:
        """The fields of B objects with codes (B, K): the basis collapses into one grid per object."""
        return GridShape(self.values(code), self.basis, self.origin, self.spacing_m)

    def dimensions_hwl(self, code: Tensor) -> Tensor:
        """Height, width and length (B, 3), metres, that codes (B, K) have by the linear map of the training cars.

        Examples:
            >>> prior = PCAShapePrior.load_bundled()
            >>> bool((prior.dimensions_hwl(prior.initial_code(1)) == prior.dimensions_mean_hwl).all())
            True
        """
        check_shape("code", code, ("B", self.num_codes))
        return self.dimensions_mean_hwl + code @ self.dimensions_basis_hwl.T

    def dimensions_and_derivative(self, code: Tensor) -> DimensionsDerivative:
        """`dimensions_hwl` with its constant derivative, (B, 3) and (B, 3, K)."""
        return DimensionsDerivative(self.dimensions_hwl(code), self.dimensions_basis_hwl.expand(len(code), -1, -1))

    def with_num_codes(self, num_codes: int) -> PCAShapePrior:
        """The prior of the first components only.

        Raises:
            InputError: more components asked for than there are, or none.
        """
        if not 1 <= num_codes <= self.num_codes:
            raise InputError("num_codes", f"1..{self.num_codes}", f"{num_codes}", "build a prior with more components")
        return PCAShapePrior(
            self.mean.clone(),
            self.basis[..., :num_codes].clone(),
            self.origin.clone(),
            self.spacing_m,
            explained_variance_ratio=self.explained_variance_ratio[:num_codes].clone(),
            dimensions_mean_hwl=self.dimensions_mean_hwl.clone(),
            dimensions_basis_hwl=self.dimensions_basis_hwl[:, :num_codes].clone(),
            dimensions_std_hwl=self.dimensions_std_hwl.clone(),
            provenance=self.provenance,
        )

    @classmethod
    def fit(
        cls,
        sdf_samples: Tensor,  # (N, nx, ny, nz)
        origin: Tensor,  # (3,)
        spacing_m: float,
        num_codes: int,
        provenance: PriorProvenance,
        surface_band_m: float | None = _SURFACE_BAND_M,
    ) -> PCAShapePrior:
        """Principal components of N signed distance grids.

        Args:
            sdf_samples: grids of N > num_codes cars, metres, untruncated.
            origin: node (0, 0, 0) of the grids, (3,), metres.
            spacing_m: between their nodes.
            num_codes: components to keep.
            provenance: kept inside the prior.
            surface_band_m: nodes count by how near they are to the samples' surfaces (Gaussian of this width), because
                refinement looks at the zero level only; the far field follows by regression. None counts all alike.

        Raises:
            InputError: too few samples, or non-finite ones.

        Examples:
            >>> x = torch.linspace(-1, 1, 9)
            >>> radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1)
            >>> spheres = torch.stack([radius - r for r in (0.5, 0.6, 0.7)])
            >>> made = PriorProvenance("an example", "Apache-2.0", 3)
            >>> prior = PCAShapePrior.fit(spheres, torch.full((3,), -1.0), 0.25, 1, made)
            >>> round(prior.explained_variance_ratio.item(), 4)
            1.0
        """
        _check_samples(sdf_samples, num_codes)
        check_shape("origin", origin, (3,), kind="floating")
        check_stored("origin", origin)
        check_positive("spacing_m", spacing_m)
        samples = sdf_samples.double().flatten(1)
        mean = samples.mean(dim=0)
        code, explained = _whitened_codes(samples - mean, _surface_weight(samples, surface_band_m), num_codes)
        # The code has mean 0, variance 1 and no correlations: the regression of anything on it is this product.
        basis = (samples - mean).T @ code / (len(samples) - 1)
        extents = zero_level_extents(sdf_samples.double(), origin.double(), spacing_m)
        dimensions = (extents[:, 1] - extents[:, 0])[:, [1, 2, 0]]
        dimensions_mean = dimensions.mean(dim=0)
        grid = sdf_samples.shape[1:]
        return cls(
            mean.reshape(grid).to(sdf_samples),
            basis.reshape(*grid, num_codes).to(sdf_samples),
            origin.to(sdf_samples),
            spacing_m,
            explained_variance_ratio=explained.to(sdf_samples),
            dimensions_mean_hwl=dimensions_mean.to(sdf_samples),
            dimensions_basis_hwl=((dimensions - dimensions_mean).T @ code / (len(samples) - 1)).to(sdf_samples),
            dimensions_std_hwl=dimensions.std(dim=0).to(sdf_samples),
            provenance=provenance,
        )

    def save(self, path: Path | str, grid_dtype: str = "float32") -> None:
        """Write an npz file, atomically; `grid_dtype="float16"` halves it (rounding below 1 mm near the surface)."""
        from directshape_torch.shape.prior_file import write_prior

        write_prior(self, Path(path), grid_dtype)

    @classmethod
    def load(cls, path: Path | str) -> PCAShapePrior:
        """Read a file of `save`, float32 on the CPU.

        Raises:
            DataFormatError: not such a file, another schema, or arrays that do not fit together.
        """
        from directshape_torch.shape.prior_file import read_prior

        return read_prior(Path(path))

    @classmethod
    def load_bundled(cls) -> PCAShapePrior:
        """The passenger cars that come with the package (from `parametric_cars`; licence of this project)."""
        return cls.load(Path(__file__).parents[1] / "assets" / "car_prior.npz")

    def get_extra_state(self) -> Tensor:
        return torch.tensor(self.spacing_m, dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        self.spacing_m = float(state)


def training_codes(sdf_samples: Tensor, num_codes: int) -> Tensor:
    """The whitened codes (N, K) of the samples that `PCAShapePrior.fit` is made from, float64.

    Raises:
        InputError: too few samples, or non-finite ones.
    """
    _check_samples(sdf_samples, num_codes)
    samples = sdf_samples.double().flatten(1)
    return _whitened_codes(samples - samples.mean(dim=0), _surface_weight(samples, _SURFACE_BAND_M), num_codes)[0]


def _check_samples(sdf_samples: Tensor, num_codes: int) -> None:
    check_shape("sdf_samples", sdf_samples, ("N", "nx", "ny", "nz"), kind="floating")
    check_stored("sdf_samples", sdf_samples)
    check_type("num_codes", num_codes, (int,))
    if num_codes < 1 or len(sdf_samples) <= num_codes:
        raise InputError(
            "sdf_samples", f"more than num_codes = {num_codes} samples", f"{len(sdf_samples)}", "lower num_codes"
        )
    if not bool(torch.isfinite(sdf_samples).all()):
        raise InputError("sdf_samples", "finite distances", "NaN or infinity", "check the meshes")
    if not bool((sdf_samples.flatten(1).amin(dim=1) < 0).all() and (sdf_samples.flatten(1).amax(dim=1) > 0).all()):
        raise InputError("sdf_samples", "an inside (negative) and an outside in each sample", "a grid without surface")


def _surface_weight(samples: Tensor, band_m: float | None) -> Tensor:
    """Weight of each node, (V,): how near it is to the surfaces of the samples (N, V)."""
    if band_m is None:
        return torch.ones_like(samples[0])
    weight = torch.exp(-0.5 * (samples / band_m) ** 2).mean(dim=0)
    return weight + 1e-3 * weight.max()


def _whitened_codes(centred: Tensor, weight: Tensor, num_codes: int) -> tuple[Tensor, Tensor]:
    """Codes (N, K) of the samples (N, V), variance 1 each, and the shares of variance explained (K,)."""
    gram = (centred * weight) @ centred.T
    eigenvalues, vectors = torch.linalg.eigh(gram)
    eigenvalues, vectors = eigenvalues.flip(0).clamp_min(0), vectors.flip(1)[:, :num_codes]
    # A component's sign is free: positive makes the car larger, so that priors made on different machines agree.
    growth = centred.mean(dim=1) @ vectors
    vectors = vectors * torch.where(growth > 0, -1.0, 1.0)
    return vectors * (len(centred) - 1) ** 0.5, eigenvalues[:num_codes] / eigenvalues.sum()


def _gradient_bound(mean: Tensor, basis: Tensor, code_norm: float) -> Tensor:
    """Largest gradient (per node spacing) inside any cell, over all codes of norm up to `code_norm`.

    In a cell each component of the trilinear gradient is a convex combination of four edge differences.
    """
    squared = torch.zeros_like(mean[1:, 1:, 1:])
    for axis in range(3):
        edges = mean.diff(dim=axis).abs() + code_norm * basis.diff(dim=axis).norm(dim=-1)
        for other in (a for a in range(3) if a != axis):
            count = edges.shape[other] - 1
            edges = torch.maximum(edges.narrow(other, 0, count), edges.narrow(other, 1, count))
        squared = squared + edges**2
    return squared.max().sqrt()
