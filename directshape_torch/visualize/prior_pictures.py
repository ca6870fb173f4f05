"""Pictures of a shape prior: its mean and its components as shaded cars."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

_TILE_WIDTH, _TILE_HEIGHT = 300, 170
_PIXELS_PER_METRE = 52.0
# Azimuth of the view about the vertical and elevation above the ground, degrees.
_VIEWS = ((35.0, 18.0), (0.0, 0.0), (215.0, 18.0))
_TOWARDS_LIGHT = np.array([-0.35, -0.75, -0.56])
_PAINT_BGR = np.array([205.0, 130.0, 60.0])


def prior_picture(prior: PCAShapePrior, num_sigma: float = 2.0) -> Image:
    """The mean, then each component at -+ `num_sigma` standard deviations, each from three sides.

    Returns:
        (H, W, 3) uint8, BGR, as OpenCV writes it.

    Examples:
        >>> picture = prior_picture(PCAShapePrior.load_bundled().with_num_codes(1))
        >>> picture.shape[2], bool((picture < 128).any())
        (3, True)
    """
    mean = _row(prior, prior.mean)
    rows = [_labelled("mean", np.concatenate([mean, np.full_like(mean, 255)], axis=1))]
    for k in range(prior.num_codes):
        pair = [_row(prior, prior.mean + sign * num_sigma * prior.basis[..., k]) for sign in (-1, 1)]
        share = 100 * float(prior.explained_variance_ratio[k])
        text = f"component {k + 1}, -{num_sigma:g} and +{num_sigma:g} sigma, {share:.1f} % of the variance"
        rows.append(_labelled(text, np.concatenate(pair, axis=1)))
    return np.pad(np.concatenate(rows), ((8, 8), (8, 8), (0, 0)), constant_values=255)


def shaded_view(
    vertices_obj: Array,
    faces: NDArray[Any],
    azimuth_deg: float,
    elevation_deg: float,
    paint_bgr: Array = _PAINT_BGR,
) -> Image:
    """Orthographic picture of a closed mesh with outward faces, (H, W, 3) uint8; far faces are painted first.

    Args:
        vertices_obj: (V, 3) x forward, y down, ground at y = 0, metres.
        faces: (F, 3).
        azimuth_deg: 0 looks at the car's side, its front to the right of the picture.
        elevation_deg: of the viewer above the ground.
        paint_bgr: (3,) or (F, 3) colours of all faces or of each, 0..255.

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
    colours = np.broadcast_to(paint_bgr, (len(faces), 3)) * brightness[:, None]
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


def _row(prior: PCAShapePrior, values: torch.Tensor) -> Image:
    mesh = sdf_to_mesh(values, prior.origin, prior.spacing_m)
    views = [shaded_view(np.asarray(mesh.vertices), np.asarray(mesh.faces), *view) for view in _VIEWS]
    return np.concatenate(views, axis=1)


def _labelled(text: str, image: Image) -> Image:
    import cv2

    cv2.putText(image, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1, cv2.LINE_AA)
    return image
