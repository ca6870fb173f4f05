"""Every shape model offers a signed distance field bound to a code, for ray casting, silhouettes and meshing.

Signed distances are in metres and NEGATIVE inside (the paper's Phi is positive inside: `Phi = -sdf`). Points are in
the object frame: x forward, y down, origin on the ground under the box centre.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

from torch import Tensor


class SdfDerivatives(NamedTuple):
    """`SdfDerivatives` are the value and first derivatives of signed distance fields at points, from one lookup."""

    value: Tensor  # (P,) metres
    gradient: Tensor  # d value / d point_obj, in the shape of the points: (P, 3), inside of terms (3, ...)
    J_value_code: Tensor  # (P, K) d value / d code, metres per standard deviation


class DimensionsDerivative(NamedTuple):
    """These are the outer dimensions of B shapes that a prior predicts from the code, and their derivative."""

    hwl: Tensor  # (B, 3) height, width, length, metres
    J_hwl_code: Tensor  # (B, 3, K) metres per standard deviation


class BoundShape(Protocol):
    """A `BoundShape` is the signed distance fields of B objects whose codes are fixed."""

    def value(
        self,
        points_obj: Tensor,  # (P, 3)
        object_index: Tensor,  # (P,) integer in 0..B-1
    ) -> Tensor:  # (P,)
        """Signed distance at points, metres."""
        ...

    def value_and_derivatives(
        self,
        points_obj: Tensor,  # (P, 3)
        object_index: Tensor,  # (P,)
    ) -> SdfDerivatives:
        """Signed distance, its spatial gradient and its derivative by the code, in one pass."""
        ...


class ShapePrior(Protocol):
    """A `ShapePrior` is a family of shapes with a whitened code: each component has standard deviation 1.

    The refiner, its terms, results, batch program and pictures use nothing else of a prior. A prior is an `nn.Module`,
    so that `.to(...)` moves it and a `state_dict` holds it; it has the dtype and device of `origin`. Shapes may be
    encoded in any way, and derivatives may depend on the code.
    """

    @property
    def num_codes(self) -> int: ...

    @property
    def bounds_obj(self) -> Tensor:
        """Lower and upper corner of the region where the field is known, (2, 3), metres."""
        ...

    @property
    def origin(self) -> Tensor:
        """Node (0, 0, 0) of the grid on which surfaces are measured and meshed, (3,), metres."""
        ...

    @property
    def spacing_m(self) -> float:
        """Distance between the nodes of the measuring grid."""
        ...

    def initial_code(self, num_objects: int) -> Tensor:
        """Codes (B, K) of the mean shape."""
        ...

    def bind(
        self,
        code: Tensor,  # (B, K)
    ) -> BoundShape:
        """The fields of B objects with these codes."""
        ...

    def values(
        self,
        code: Tensor,  # (B, K)
    ) -> Tensor:  # (B, nx, ny, nz)
        """Signed distance at the nodes of the measuring grid, metres: for boxes and meshes only."""
        ...

    def dimensions_and_derivative(
        self,
        code: Tensor,  # (B, K)
    ) -> DimensionsDerivative:
        """Predicted height, width and length; smooth in the code, unlike the extents of the zero level."""
        ...

    def named_buffers(self) -> Iterator[tuple[str, Tensor]]:
        """Constants of the prior by name, as from an `nn.Module`."""
        ...

    def named_parameters(self) -> Iterator[tuple[str, Tensor]]:
        """Trained weights of the prior by name, as from an `nn.Module`."""
        ...
