"""Parametric passenger cars: measures drawn at random, their solid, signed distance, closed mesh and named parts.

The object frame is used throughout: x forward, y down, z = x cross y, ground at y = 0, origin under the middle of the
car. Everything is deterministic in the seed. Free of any foreign model: the shapes come from a dozen key points of the
side view, a plan taper and a leaning cross-section.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.shape.parametric_cars_solid import (
    GLASS,
    LIGHT,
    PAINT,
    PART_NAMES,
    PLATE,
    RIM,
    TRIM,
    TYRE,
    Array,
    car_part_labels,
    implicit,
)
from directshape_torch.shape.parametric_cars_types import BODY_TYPES, CarParameters, sample_car

if TYPE_CHECKING:
    import trimesh
    from scipy.spatial import cKDTree

__all__ = [
    "BODY_TYPES",
    "GLASS",
    "LIGHT",
    "PAINT",
    "PART_NAMES",
    "PLATE",
    "RIM",
    "TRIM",
    "TYRE",
    "CarParameters",
    "car_mesh",
    "car_part_labels",
    "car_sdf",
    "sample_car",
]

_SURFACE_SPACING_M = 0.04


def car_mesh(parameters: CarParameters, spacing_m: float = 0.03) -> trimesh.Trimesh:
    """Closed triangle mesh of a car in the object frame, normals outward.

    Args:
        parameters: the measures, from `sample_car`.
        spacing_m: sampling of the solid; edges are about as long.

    Raises:
        InputError: spacing not within 5 mm to 0.2 m.

    Examples:
        >>> mesh = car_mesh(sample_car(3, "city"), spacing_m=0.08)
        >>> bool(mesh.is_watertight), bool(mesh.volume > 3.0)
        (True, True)
    """
    import trimesh

    if not 0.005 <= spacing_m <= 0.2:
        raise InputError("spacing_m", "0.005 to 0.2", f"{spacing_m}")
    vertices, faces = _half_symmetric_surface(parameters, spacing_m)
    return trimesh.Trimesh(vertices, faces, process=False)


def car_sdf(parameters: CarParameters, points_obj: Array) -> Array:
    """Signed distance (N,) of points (N, 3) to a car's surface, metres, negative inside.

    Distances are to the tangent plane of the nearest of densely sampled surface points when they are near, so that
    they are right to a few millimetres; the solid's implicit function is no distance where its parts are bent.

    Examples:
        >>> car = sample_car(3, "city")
        >>> bool(car_sdf(car, np.array([[0.0, -0.6, 0.0]]))[0] < -0.2)
        True
    """
    points = np.asarray(points_obj, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError("points_obj", "shape (N, 3)", str(points.shape))
    tree, vertices, normals = _surface_tree(parameters)
    distance, nearest = tree.query(points)
    offset = points - vertices[nearest]
    along_normal = np.abs((offset * normals[nearest]).sum(axis=1))
    near = distance < 1.5 * _SURFACE_SPACING_M
    unsigned = np.where(near, along_normal, distance)
    return np.asarray(np.where(implicit(parameters, points) < 0, -unsigned, unsigned))


@lru_cache(maxsize=4)
def _surface_tree(parameters: CarParameters) -> tuple[cKDTree, Array, Array]:
    from scipy.spatial import cKDTree

    mesh = car_mesh(parameters, _SURFACE_SPACING_M)
    vertices = np.asarray(mesh.vertices)
    return cKDTree(vertices), vertices, np.asarray(mesh.vertex_normals)


def _half_symmetric_surface(car: CarParameters, spacing_m: float) -> tuple[Array, NDArray[np.int32]]:
    """Marching cubes of the solid; the implicit function is evaluated on one half and mirrored."""
    from skimage.measure import marching_cubes

    margin = 3 * spacing_m
    x = np.arange(-0.5 * car.length - margin, 0.5 * car.length + margin + spacing_m, spacing_m)
    y = np.arange(-car.height - margin, margin + spacing_m, spacing_m)
    # A node plane off the middle (half a step) keeps the mirrored halves from sharing degenerate triangles.
    z_half = (np.arange(int((0.5 * car.width + margin) / spacing_m) + 2) + 0.5) * spacing_m
    nodes = np.stack(np.meshgrid(x, y, z_half, indexing="ij"), axis=-1).reshape(-1, 3)
    half = implicit(car, nodes).reshape(len(x), len(y), len(z_half))
    values = np.concatenate([half[:, :, ::-1], half], axis=2)
    extract: Callable[..., tuple[Array, NDArray[np.int32], Array, Array]] = marching_cubes
    vertices, faces, _, _ = extract(values, 0.0, spacing=(spacing_m,) * 3, gradient_direction="descent")
    origin = np.array([x[0], y[0], -z_half[-1]])
    return vertices + origin, faces
