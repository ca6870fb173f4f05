"""Shapes coloured by signed distance: surfaces from outside, fields in the middle plane, a car before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.io.figure_files import new_figure, write_figure
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.inspection.car_view import CarView

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

_TILE_WIDTH, _TILE_HEIGHT = 300, 170
_PIXELS_PER_METRE = 52.0
_TOWARDS_LIGHT = np.array([-0.35, -0.75, -0.56])


def shaded_view(
    vertices_obj: Array,
    faces: NDArray[Any],
    azimuth_deg: float,
    elevation_deg: float,
    paint_rgb: Array,
) -> Image:
    """Orthographic picture of a closed mesh with outward faces, (H, W, 3) RGB uint8; far faces are painted first.

    Args:
        vertices_obj: (V, 3) x forward, y down, ground at y = 0, metres.
        faces: (F, 3).
        azimuth_deg: 0 looks at the car's side, its front to the right of the picture.
        elevation_deg: of the viewer above the ground.
        paint_rgb: (3,) or (F, 3) colours of all faces or of each, 0..255.

    Raises:
        InputError: no faces.
    """
    import cv2

    if len(faces) == 0:
        raise InputError("faces", "at least one face", "none")
    view = (vertices_obj - [0.0, -0.7, 0.0]) @ _rotation(azimuth_deg, elevation_deg).T
    corners = view[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = _smooth_normals(len(vertices_obj), faces, normals)
    brightness = 0.35 + 0.65 * np.clip(smooth @ (_TOWARDS_LIGHT / np.linalg.norm(_TOWARDS_LIGHT)), 0.0, 1.0)
    pixels = corners[:, :, :2] * _PIXELS_PER_METRE + [0.5 * _TILE_WIDTH, 0.5 * _TILE_HEIGHT]
    image = np.full((_TILE_HEIGHT, _TILE_WIDTH, 3), 255, dtype=np.uint8)
    colours = np.broadcast_to(paint_rgb, (len(faces), 3)) * brightness[:, None]
    fixed_point = np.round(pixels * 16).astype(np.int32)
    for k in np.argsort(-corners[:, :, 2].mean(axis=1), kind="stable"):
        if normals[k, 2] < 0:
            cv2.fillConvexPoly(image, fixed_point[k], colours[k].tolist(), shift=4)
    return image


def _smooth_normals(num_vertices: int, faces: NDArray[Any], normals: Array) -> Array:
    """Unit normal of each face, averaged over the faces around its vertices."""
    at_vertices = np.zeros((num_vertices, 3))
    for corner in range(3):
        np.add.at(at_vertices, faces[:, corner], normals)
    averaged = at_vertices[faces].sum(axis=1)
    return np.asarray(averaged / np.maximum(np.linalg.norm(averaged, axis=1, keepdims=True), 1e-12))


def _rotation(azimuth_deg: float, elevation_deg: float) -> Array:
    a, e = np.radians([azimuth_deg, elevation_deg])
    about_vertical = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
    return np.asarray(tilt @ about_vertical)


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
    return shaded_view(vertices, faces, *direction, colours)


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


_SIZE_INCHES = (11.0, 3.9)


def write_shape_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: surfaces coloured by their distance to the input's shape, and fields in the middle.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(*_SIZE_INCHES, "drawing shapes")
    figure.suptitle(view.title)
    axes = figure.subplots(2, 3)
    prior = view.prior
    before, after = (prior.values(view.state(k).code)[0] for k in (0, len(view.trace) - 1))
    for row, (name, values) in enumerate((("before", before), ("after", after))):
        for column, direction in enumerate((FRONT_VIEW, REAR_VIEW)):
            axes[row, column].imshow(coloured_surface(prior, values, before, direction, SURFACE_LIMIT_M))
            axes[row, column].axis("off")
        field = show_section(axes[row, 2], prior, values, FIELD_LIMIT_M, f"{name}: field in the middle plane")
    axes[0, 0].set_title("before", fontsize=9)
    axes[1, 0].set_title("after, coloured by its distance from the surface before", fontsize=9, loc="left")
    bars = {"shrink": 0.8, "extend": "both"}
    figure.colorbar(distance_scale(SURFACE_LIMIT_M), ax=axes[:, :2], label="outside of the surface before [m]", **bars)
    figure.colorbar(field, ax=axes[:, 2], label="signed distance [m]", **bars)
    write_figure(path, figure)
