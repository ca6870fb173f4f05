"""A small multilayer perceptron is a shape prior: it maps code and point to a signed distance, without any grid.

Every layer adds a shift that is linear in the code, so binding a code costs one small product a car. The point is
mirrored smoothly about the middle plane of the car before it enters, so all shapes are symmetric.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from directshape_torch.errors import InputError, shown
from directshape_torch.numerics.checks import check_alike, check_shape
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.shape.prior_file import PriorProvenance, read_prior, write_prior
from directshape_torch.shape.shape_prior import DimensionsDerivative, SdfDerivatives

# The mirrored coordinate `sqrt(z^2 + s^2)` is rounded within this distance s of the middle plane.
MIRROR_ROUNDING_M = 0.2
# The first layer has this typical frequency before training, because details of cars are a few decimetres large.
FIRST_RADIANS_PER_M = 3.0
_MOST_NODES = 2**24
_CURE = "make one with: python scripts/train_neural_prior.py"
# This many points are computed together, so that their activations stay in a core's cache, which is twice as fast.
_CHUNK_POINTS = 4096


class CodedLinear(nn.Module):
    """This layer computes `W x + C code + b`."""

    def __init__(self, inputs: int, outputs: int, num_codes: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs) * inputs**-0.5)
        self.code_weight = nn.Parameter(torch.randn(outputs, num_codes) * 0.3 * inputs**-0.5)
        self.bias = nn.Parameter(torch.zeros(outputs))

    @in_full_precision
    def shift(self, code: Tensor) -> Tensor:
        """`C code + b`, (B, outputs)."""
        return code @ self.code_weight.T + self.bias


class NeuralShapePrior(nn.Module):
    """This `ShapePrior` computes signed distances by a network of sine and SiLU layers with a whitened code.

    All layers are smooth, so derivatives of any order exist inside the bounds. The weights are parameters without
    `requires_grad`; `prior.requires_grad_()` makes them trainable.

    Args:
        layer_widths: units of the hidden layers.
        num_codes: number K of components of the code.
        origin: node (0, 0, 0) of the measuring grid in the object frame, (3,), metres.
        grid_shape: nodes of the measuring grid; it also spans the bounds of the field.
        spacing_m: distance between nodes of the measuring grid.
        provenance: where the weights come from.

    Raises:
        InputError: no hidden layer, or a grid without extent.

    Examples:
        >>> prior = NeuralShapePrior.load_bundled()
        >>> shape = prior.bind(prior.initial_code(2))
        >>> at = shape.value_and_derivatives(torch.tensor([[0.0, -0.7, 0.0]]), torch.tensor([1]))
        >>> bool(at.value < 0), at.gradient.shape, at.J_value_code.shape[1] == prior.num_codes
        (True, torch.Size([1, 3]), True)
    """

    SCHEMA: ClassVar = "directshape_torch.neural_shape_prior/1"

    origin: Tensor
    dimensions_mean_hwl: Tensor
    dimensions_linear_hwl: Tensor
    dimensions_quadratic_hwl: Tensor

    def __init__(
        self,
        layer_widths: Sequence[int],
        num_codes: int,
        origin: Tensor,
        grid_shape: tuple[int, int, int],
        spacing_m: float,
        provenance: PriorProvenance,
    ) -> None:
        super().__init__()
        # `check_shape` would refuse the tensors without numbers of which `load` makes the prior.
        if not isinstance(origin, Tensor) or origin.shape != (3,):
            raise InputError("origin", "a tensor of shape (3,)", shown(origin))
        if not layer_widths or num_codes < 1:
            raise InputError("layer_widths, num_codes", "at least one each", f"{list(layer_widths)}, {num_codes}")
        if min(grid_shape) < 2 or not spacing_m > 0:
            raise InputError("grid_shape, spacing_m", "two nodes along each axis", f"{grid_shape}, {spacing_m}")
        widths = [3, *layer_widths, 1]
        self.layers = nn.ModuleList(CodedLinear(a, b, num_codes) for a, b in itertools.pairwise(widths))
        self.register_buffer("origin", origin)
        self.register_buffer("dimensions_mean_hwl", origin.new_zeros(3))
        self.register_buffer("dimensions_linear_hwl", origin.new_zeros(3, num_codes))
        self.register_buffer("dimensions_quadratic_hwl", origin.new_zeros(3, num_codes, num_codes))
        self.layer_widths, self.num_codes = tuple(layer_widths), num_codes
        self.grid_shape, self.spacing_m = grid_shape, float(spacing_m)
        self.provenance = provenance
        self.to(origin).requires_grad_(False)
        self.coded_layers()[0].weight.mul_(FIRST_RADIANS_PER_M)

    @property
    def bounds_obj(self) -> Tensor:
        """Lower and upper corner of the region that the network was trained for, (2, 3), metres."""
        last_node = constant_like(self.grid_shape, self.origin) - 1
        return torch.stack([self.origin, self.origin + self.spacing_m * last_node])

    def initial_code(self, num_objects: int) -> Tensor:
        """Codes of the mean of the training cars, (B, K) zeros."""
        return self.origin.new_zeros(num_objects, self.num_codes)

    @in_full_precision
    def bind(self, code: Tensor) -> NeuralShape:
        """The fields of B objects with codes (B, K)."""
        check_shape("code", code, ("B", self.num_codes))
        check_alike("code", code, "the prior", self.origin)
        layers = self.coded_layers()
        return NeuralShape(
            [layer.weight for layer in layers],
            [layer.code_weight for layer in layers],
            [layer.shift(code) for layer in layers],
            self.bounds_obj,
        )

    @in_full_precision
    def values(self, code: Tensor) -> Tensor:
        """Signed distance at the nodes of the measuring grid, (B, nx, ny, nz), metres, for codes (B, K)."""
        shape, nodes = self.bind(code), self._nodes()
        owners = torch.arange(len(code), device=nodes.device)
        fields = [shape.value(nodes, owner.expand(len(nodes))) for owner in owners]
        return torch.stack(fields).view(-1, *self.grid_shape) if fields else nodes.new_zeros(0, *self.grid_shape)

    @in_full_precision
    def dimensions_and_derivative(self, code: Tensor) -> DimensionsDerivative:
        """Height, width and length (B, 3), metres: a quadratic of the code, fitted to the training cars."""
        check_shape("code", code, ("B", self.num_codes))
        check_alike("code", code, "the prior", self.origin)
        quadratic = self.dimensions_quadratic_hwl
        by_code = torch.einsum("dkl,bl->bdk", quadratic + quadratic.transpose(1, 2), code)
        hwl = self.dimensions_mean_hwl + code @ self.dimensions_linear_hwl.T + 0.5 * (by_code @ code[..., None])[..., 0]
        return DimensionsDerivative(hwl, self.dimensions_linear_hwl + by_code)

    def save(self, path: Path | str) -> None:
        """Write a safetensors file, atomically."""
        names = ("layer_widths", "num_codes", "grid_shape", "spacing_m")
        settings = {name: getattr(self, name) for name in names}
        tensors = {**dict(self.named_parameters()), **dict(self.named_buffers())}
        write_prior(path, self.SCHEMA, self.provenance, tensors, **settings)

    @classmethod
    def load(cls, path: Path | str) -> NeuralShapePrior:
        """Read a file that `save` wrote, as float32 on the CPU; it raises the errors of `PCAShapePrior.load`."""

        def make(tensors: dict[str, Tensor], made: PriorProvenance, settings: dict[str, Any]) -> NeuralShapePrior:
            widths, (nx, ny, nz) = settings["layer_widths"], settings["grid_shape"]
            if len(widths) > len(tensors) or math.prod((nx, ny, nz)) > _MOST_NODES:
                raise ValueError(f"more layers than tensors, or more than {_MOST_NODES} nodes")
            # The sizes come from a file that may be wrong, so the prior takes no memory until it is filled.
            with torch.device("meta"):
                origin = torch.zeros(3)
                prior = cls(widths, settings["num_codes"], origin, (nx, ny, nz), settings["spacing_m"], made)
            prior.load_state_dict(tensors, assign=True)
            return prior

        return read_prior(path, cls.SCHEMA, _CURE, make)

    @classmethod
    def load_bundled(cls) -> NeuralShapePrior:
        """The prior of passenger cars in the package (by `scripts/train_neural_prior.py`; licence of this project)."""
        return cls.load(Path(__file__).parents[1] / "assets" / "neural_prior.safetensors")

    def coded_layers(self) -> list[CodedLinear]:
        """The layers in order, the sine layer first."""
        return [layer for layer in self.layers if isinstance(layer, CodedLinear)]

    def _nodes(self) -> Tensor:
        axes = [
            self.origin[k] + self.spacing_m * torch.arange(n, dtype=self.origin.dtype, device=self.origin.device)
            for k, n in enumerate(self.grid_shape)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


class NeuralShape:
    """This `BoundShape` is a network with fixed codes of B objects: each layer has one shift for each object."""

    def __init__(
        self, weights: Sequence[Tensor], code_weights: Sequence[Tensor], shifts: Sequence[Tensor], bounds_obj: Tensor
    ) -> None:
        self._weights, self._code_weights, self._shifts = weights, code_weights, shifts
        self._bounds = bounds_obj

    @in_full_precision
    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """Signed distance (P,) in metres at points (P, 3) of objects (P,)."""
        return torch.cat([self._value(*part) for part in _in_parts(points_obj, object_index)])

    def _value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        clamped, outward = self._split(points_obj)
        x = torch.sin(self._linear(0, _mirrored(clamped), object_index))
        for i in range(1, len(self._weights) - 1):
            x = nn.functional.silu(self._linear(i, x, object_index))
        return self._linear(-1, x, object_index)[:, 0] + _safe_norm(outward)

    @in_full_precision
    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        """Value (P,), gradient (P, 3) and code derivative (P, K) at points (P, 3) of objects (P,).

        The chain rule is written out in differentiable operations: the way forward keeps the slope of each layer, and
        the way back multiplies by it. The way back costs one product a layer, forward mode would cost 3 + K.
        """
        parts = [self._value_and_derivatives(*part) for part in _in_parts(points_obj, object_index)]
        return SdfDerivatives(*(torch.cat(field) for field in zip(*parts, strict=True)))

    def _value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        clamped, outward = self._split(points_obj)
        a = self._linear(0, _mirrored(clamped), object_index)
        x, slopes = torch.sin(a), [torch.cos(a)]
        for i in range(1, len(self._weights) - 1):
            a = self._linear(i, x, object_index)
            gate = torch.sigmoid(a)
            x = a * gate
            slopes.append(gate + x * (1 - gate))
        value = self._linear(-1, x, object_index)[:, 0]
        J_value_x = self._weights[-1].expand(len(points_obj), -1)
        J_value_code = self._code_weights[-1].expand(len(points_obj), -1)
        for i in reversed(range(len(slopes))):
            J_value_a = J_value_x * slopes[i]
            J_value_code = J_value_code + J_value_a @ self._code_weights[i]
            J_value_x = J_value_a @ self._weights[i]
        distance = _safe_norm(outward)
        direction = outward / torch.where(distance > 0, distance, torch.ones_like(distance))[:, None]
        gradient = J_value_x * _mirrored_slope(clamped)
        # NaN is not equal to zero, so no NaN of a point passes through the network's gradient.
        gradient = torch.where(outward == 0, gradient, torch.zeros_like(gradient)) + direction
        return SdfDerivatives(value + distance, gradient, J_value_code)

    def _split(self, points_obj: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest points within the bounds and the vectors from there to the points, both (P, 3)."""
        clamped = torch.minimum(torch.maximum(points_obj, self._bounds[0]), self._bounds[1])
        return clamped, points_obj - clamped

    def _linear(self, i: int, x: Tensor, object_index: Tensor) -> Tensor:
        return torch.addmm(self._shifts[i].index_select(0, object_index), x, self._weights[i].T)


def _in_parts(points_obj: Tensor, object_index: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    return zip(torch.split(points_obj, _CHUNK_POINTS), torch.split(object_index, _CHUNK_POINTS), strict=True)


def _mirrored(points: Tensor) -> Tensor:
    """Points `(x, y, sqrt(z^2 + s^2))`, which are smooth and equal for both halves of a car."""
    z = points[:, 2:]
    return torch.cat([points[:, :2], (z * z + MIRROR_ROUNDING_M**2).sqrt()], dim=1)


def _mirrored_slope(points: Tensor) -> Tensor:
    z = points[:, 2:]
    slope = z / (z * z + MIRROR_ROUNDING_M**2).sqrt()
    return torch.cat([torch.ones_like(points[:, :2]), slope], dim=1)


def _safe_norm(vector: Tensor) -> Tensor:
    """Euclidean norm whose gradient at zero is zero instead of NaN."""
    squared = (vector * vector).sum(-1)
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, torch.ones_like(squared)).sqrt(), squared)
