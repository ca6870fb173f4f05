"""Shapes with colour-coded signed distance: surfaces from outside, and their field in a plane through the middle."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.prior_pictures import Image, shaded_view

Array = NDArray[np.float64]

COLOURS = "RdBu_r"
"""Red outside, blue inside."""
SURFACE_LIMIT_M, FIELD_LIMIT_M = 0.25, 1.0
"""Where the colours of surfaces that differ a little, and of fields, are full."""
FRONT_VIEW, REAR_VIEW = (35.0, 18.0), (215.0, 18.0)
"""Azimuth and elevation of a viewer, degrees."""


def surface_colours(values: Array, limit_m: float) -> Array:
    """Colours (N, 3) in 0..255 of signed distances (N,), saturated beyond `limit_m`; near zero almost white."""
    from matplotlib import colormaps

    return np.asarray(colormaps[COLOURS](0.5 + 0.5 * np.clip(values / limit_m, -1, 1))[:, :3] * 255)


def coloured_surface(
    prior: ShapePrior,
    values: Tensor,  # (nx, ny, nz) of the shape to draw, on the prior's grid
    other: Tensor,  # (nx, ny, nz) of the shape to compare it with
    direction: tuple[float, float],
    limit_m: float,
) -> Image:
    """A shape's surface, coloured by its signed distance to another shape; (h, w, 3) RGB."""
    mesh = sdf_to_mesh(values, prior.origin, prior.spacing_m)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    middle_of_faces = vertices[faces].mean(axis=1)
    distance = distance_at(prior, other, middle_of_faces)
    colours = surface_colours(distance, limit_m)
    return np.ascontiguousarray(shaded_view(vertices, faces, *direction, paint_bgr=colours[:, ::-1])[..., ::-1])


def distance_at(prior: ShapePrior, values: Tensor, points_obj: Array) -> Array:
    """Signed distance (N,) at points (N, 3) of a field on the prior's grid, metres; points must lie within it."""
    from scipy.interpolate import RegularGridInterpolator

    origin = prior.origin.double().cpu().numpy()
    axes = [o + prior.spacing_m * np.arange(n) for o, n in zip(origin, values.shape, strict=True)]
    grid = values.double().cpu().numpy()
    # The surface may touch the border, where meshes are closed half a node further out.
    inside = np.clip(points_obj, [axis[0] for axis in axes], [axis[-1] for axis in axes])
    return np.asarray(RegularGridInterpolator(tuple(axes), grid)(inside))


def distance_scale(limit_m: float) -> Any:
    """What a colour bar needs to explain `surface_colours`."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(-limit_m, limit_m), COLOURS)


def show_section(axes: Any, prior: ShapePrior, values: Tensor, limit_m: float, title: str = "") -> Any:
    """The field in the plane of symmetry (z = 0) and, black, its zero level. Returns what a colour bar needs."""
    plane, extent = section(prior, values)
    picture = axes.imshow(
        plane.T, extent=extent, origin="lower", cmap=COLOURS, vmin=-limit_m, vmax=limit_m, interpolation="bilinear"
    )
    draw_zero_level(axes, prior, values, "black")
    # y points down.
    axes.set(xlim=extent[:2], ylim=(extent[3], extent[2]), aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, fontsize=9)
    return picture


def draw_zero_level(axes: Any, prior: ShapePrior, values: Tensor, ink: Any, **style: Any) -> None:
    """The zero level of a field in the plane z = 0."""
    plane, (x0, x1, y0, y1) = section(prior, values)
    x, y = np.linspace(x0, x1, plane.shape[0]), np.linspace(y0, y1, plane.shape[1])
    axes.contour(x, y, plane.T, levels=[0.0], colors=[ink], linewidths=1.3, **style)


def section(prior: ShapePrior, values: Tensor) -> tuple[Array, tuple[float, float, float, float]]:
    """The field (nx, ny) in the plane z = 0, between its two nearest layers of nodes, and where it lies: x and y."""
    origin, spacing = prior.origin.double().cpu(), prior.spacing_m
    place = float(-origin[2] / spacing)
    below = min(max(int(place), 0), values.shape[2] - 2)
    share = place - below
    plane = torch.lerp(values[:, :, below].double(), values[:, :, below + 1].double(), share)
    last = origin[:2] + spacing * (torch.tensor(plane.shape, dtype=torch.float64) - 1)
    return np.asarray(plane.cpu()), (float(origin[0]), float(last[0]), float(origin[1]), float(last[1]))
