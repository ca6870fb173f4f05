"""This module has the renderer's input: triangle meshes in the road frame, each with one material."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demo_scene.camera import Array

Indices = NDArray[np.int64]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Material:
    """A `Material` is a glossy or matt surface."""

    # Linear RGB, an sRGB picture (H, W, 3), or None for the mesh's own vertex colours.
    base_color: tuple[float, float, float] | Picture | None
    roughness: float | Picture = 0.8  # 0 mirror to 1 matt, or a picture (H, W) of it, 255 for 1
    metallic: float = 0.0  # shares as in the usual principled material
    specular: float = 0.3
    clearcoat: float = 0.0


@dataclass(frozen=True)
class Surface:
    """A `Surface` is a mesh: vertices (N, 3) in the road frame, faces (M, 3), and inputs of the material."""

    vertices: Array
    faces: Indices
    material: Material
    uv: Array | None = None  # texture coordinates (N, 2), v = 0 at the texture's last row, or None
    normals: Array | None = None  # smooth vertex normals (N, 3), or None for flat faces
    colors: Array | None = None  # linear RGB of the vertices (N, 3), or None
    instance: int = -1  # number of the car that it belongs to, from 0; -1 for the street


def quad(corner: Array, edge_u: Array, edge_v: Array, material: Material) -> Surface:
    """A parallelogram; its texture's columns run along `edge_u`, its rows, from last to first, along `edge_v`."""
    vertices = np.array([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v], dtype=np.float64)
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), material, uv=uv)


def box(low: tuple[float, float, float], high: tuple[float, float, float], material: Material) -> Surface:
    """An axis-aligned box with flat faces, without texture."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    vertices = np.array(low) + corners * (np.array(high) - np.array(low))
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return Surface(vertices, np.array(faces), material)


def tube(bottom: Array, top: Array, radius_bottom: float, radius_top: float, material: Material) -> Surface:
    """A cone's frustum between two points, open at both ends, for poles and trunks."""
    axis = (top - bottom) / np.linalg.norm(top - bottom)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    count = 14
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    vertices = np.concatenate([bottom + radius_bottom * ring, top + radius_top * ring])
    k = np.arange(count)
    following = (k + 1) % count
    lower = np.stack([k, following, k + count], axis=1)
    upper = np.stack([following, following + count, k + count], axis=1)
    faces = np.concatenate([lower, upper])
    return Surface(vertices, faces, material, normals=np.concatenate([ring, ring]))
