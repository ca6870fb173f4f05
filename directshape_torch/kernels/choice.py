"""This module decides where native loops take the place of tensor operations, and gives them their arguments.

A loop has the results of its tensor operations but for rounding. It is taken for float32 on a CPU where nothing is
differentiated and, if it looks at a shape, the shape is a `GridShape`; everything else takes the tensor operations.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.kernels import arguments
from directshape_torch.numerics.gradient_mode import is_plain, nothing_is_differentiated
from directshape_torch.rows import Rays
from directshape_torch.shape.sdf_grid import BEYOND_GRIDS, NO_STEP, ON_FACE, GridShape, strides

_logger = logging.getLogger(__name__)
_is_on: ContextVar[bool] = ContextVar("directshape_torch_kernels", default=True)


@contextmanager
def without_kernels() -> Iterator[None]:
    """A region in which tensor operations do everything, to compare with.

    Examples:
        >>> with without_kernels():
        ...     _is_on.get()
        False
    """
    token = _is_on.set(False)
    try:
        yield
    finally:
        _is_on.reset(token)


def native_grid(field: object, *tensors: Tensor) -> arguments.Grid | None:
    """The grids of a field for native loops, if they take tensors like these at this place of the program, else None.

    Args:
        field: signed distances of the cars.
        tensors: what else a loop gets, at least one tensor of each origin.
    """
    # A subclass of the shape may look up anew.
    if type(field) is not GridShape or not takes_loops(field.values, field.basis, *tensors):
        return None
    return _grid(field)


def takes_loops(*tensors: Tensor) -> bool:
    """Whether native loops take tensors like these at this place of the program."""
    # No tensor is fit while the user's own compiler looks.
    is_fit = nothing_is_differentiated() and all(map(_is_fit, tensors))
    return is_fit and _is_on.get() and _is_installed()


def _is_fit(tensor: Tensor) -> bool:
    return tensor.dtype == torch.float32 and tensor.device.type == "cpu" and is_plain(tensor)


@functools.cache
def _is_installed() -> bool:
    try:
        from directshape_torch.kernels import jit, march, photometric, silhouettes  # noqa: F401
    except (ImportError, RuntimeError) as error:  # Numba raises the second where it may write its code nowhere.
        cure = "pip install 'directshape_torch[fast]', or set NUMBA_CACHE_DIR to a folder that can be written"
        _logger.warning(
            "without native loops refinements on the CPU take two to three times as long (%s): %s", error, cure
        )
        return False
    if not jit.is_compiled(march.march):
        _logger.warning("Numba compiles native loops once on this machine, which takes some 25 seconds")
    return True


def _grid(shape: GridShape) -> arguments.Grid:
    x, y, _ = strides(shape)
    return arguments.Grid(
        array(shape.values).reshape(-1),
        array(shape.basis).reshape(-1, shape.basis.shape[3]),
        np.uint64(shape.basis[..., 0].numel()),
        np.uint64(x),
        np.uint64(y),
        point(shape.last),
        point(shape.origin),
        *map(np.float32, (shape.spacing_m, 1 / shape.spacing_m, ON_FACE, NO_STEP, BEYOND_GRIDS)),
    )


def point(numbers: Tensor) -> arguments.Point:
    """Three numbers for a loop."""
    x, y, z = map(np.float32, numbers.tolist())
    return x, y, z


def array(tensor: Tensor) -> NDArray[Any]:
    """The numbers of a tensor, in one piece; a loop writes into a tensor that is in one piece already."""
    plain = tensor.detach() if tensor.requires_grad else tensor
    array: NDArray[Any] = plain.contiguous().numpy()
    return array


def room_like(tensor: Tensor) -> Tensor:
    """A tensor in one piece for a loop to write into."""
    return torch.empty_like(tensor, memory_format=torch.contiguous_format)


def native_rays(rays: Rays, T_obj_cam: Tensor) -> arguments.Rays:
    """Rays with the poses (B, 4, 4) of their cars."""
    return arguments.Rays(*map(array, (rays.owner, rays.centre_cam, rays.ray_cam, T_obj_cam)))


def every_turn(num_cars: int) -> arguments.Turn:
    """The evaluation of all cars near the points that a loop is given."""
    return arguments.Turn(np.ones(num_cars, np.bool_), np.zeros(num_cars, np.bool_))
