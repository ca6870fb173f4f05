"""This module cuts the mesh of a parametric car into parts, each with its own material."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from parametric_cars import surfaces as cars

from demo_scene.camera import Array, transform
from demo_scene.layout import PlacedCar
from demo_scene.surfaces import Indices, Material, Surface

if TYPE_CHECKING:
    import trimesh

# These parts are not in `parametric_cars`; the first are the gaps around doors, bonnet and tailgate.
_GAP = 100
_TAIL_LIGHT = 101
_SPOKE_GAP = 102
_SPLITS = 2


def car_surfaces(car: PlacedCar, mesh: trimesh.Trimesh, instance: int) -> list[Surface]:
    """One surface for each part, in the road frame; together they are the closed mesh."""
    vertices, normals, faces, part = _cut(car, mesh)
    vertices_road = transform(car.T_road_obj, vertices)
    normals_road = normals @ car.T_road_obj[:3, :3].T
    materials = _materials(car)
    surfaces = []
    for label in np.unique(part):
        used, local = np.unique(faces[part == label], return_inverse=True)
        surfaces.append(
            Surface(
                vertices_road[used],
                local.reshape(-1, 3),
                materials[int(label)],
                normals=normals_road[used],
                instance=instance,
            )
        )
    return surfaces


def _cut(car: PlacedCar, mesh: trimesh.Trimesh) -> tuple[Array, Array, Indices, Indices]:
    """Split the triangles along part borders, so that borders are accurate to a few millimetres.

    The new vertices are midpoints of straight edges, so the surface is unchanged and stays closed.
    """
    vertices, normals = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.vertex_normals, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    for _ in range(_SPLITS):
        at_vertices = part_labels(car, vertices)[faces]
        middles = vertices[faces].mean(axis=1)
        mixed = (at_vertices != part_labels(car, middles)[:, None]).any(axis=1)
        vertices, normals, faces = _split(vertices, normals, faces, mixed)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return vertices, normals, faces, part_labels(car, vertices[faces].mean(axis=1))


def _split(vertices: Array, normals: Array, faces: Indices, chosen: np.ndarray) -> tuple[Array, Array, Indices]:
    """Replace each chosen triangle by four."""
    triangles = faces[chosen]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique_edges, which = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (which.reshape(-1, 3) + len(vertices)).T
    a, b, c = triangles.T
    quarters = [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return (
        np.concatenate([vertices, vertices[unique_edges].mean(axis=1)]),
        np.concatenate([normals, normals[unique_edges].mean(axis=1)]),
        np.concatenate([faces[~chosen], *quarters]),
    )


def part_labels(car: PlacedCar, points_obj: Array) -> Indices:
    """Labels of `parametric_cars`, with separate labels for panel gaps, tail lights and the spaces between spokes."""
    p = car.parameters
    labels = cars.car_part_labels(p, points_obj)
    x, height, side = points_obj[:, 0], -points_obj[:, 1], np.abs(points_obj[:, 2])
    u = 0.5 * p.length - x
    on_side = (side > 0.36 * p.width) & (height > p.ground_clearance + 0.12) & (height < p.belt_height + 0.02)
    door_front, door_middle = p.cowl_u + 0.15, 0.52 * (p.cowl_u + 0.15) + 0.48 * p.roof_rear_u
    door_rear = min(p.front_axle_u + p.wheelbase - p.wheel_radius * 0.2, p.roof_rear_u)
    upright = np.min([np.abs(u - at) for at in (door_front, door_middle, door_rear)], axis=0) < 0.006
    sill = (np.abs(height - p.ground_clearance - 0.14) < 0.006) & (u > door_front) & (u < door_rear)
    bonnet = (np.abs(side - 0.40 * p.width) < 0.006) & (u < p.cowl_u) & (height > p.nose_height)
    handle = np.zeros(len(u), bool)
    for at in (door_middle - 0.12, door_rear - 0.12):
        handle |= (np.abs(u - at) < 0.08) & (np.abs(height - p.belt_height + 0.09) < 0.015) & on_side
    labels[(labels == cars.PAINT) & ((on_side & (upright | sill)) | bonnet | handle)] = _GAP
    labels[(labels == cars.LIGHT) & (x < 0)] = _TAIL_LIGHT
    rim = labels == cars.RIM
    axle_u = np.where(x > 0, p.front_axle_u, p.front_axle_u + p.wheelbase)
    radius = np.hypot(u - axle_u, height - p.wheel_radius)
    angle = np.arctan2(height - p.wheel_radius, u - axle_u)
    between = (np.cos(5 * angle) < 0.1) & (radius > 0.24 * p.wheel_radius) & (radius < 0.58 * p.wheel_radius)
    labels[rim & between] = _SPOKE_GAP
    return labels


def _materials(car: PlacedCar) -> dict[int, Material]:
    dark = Material((0.012, 0.012, 0.012), roughness=0.6)
    return {
        cars.PAINT: Material(car.paint_rgb, roughness=0.20, metallic=car.metallic, specular=0.9, clearcoat=1.0),
        cars.GLASS: Material((0.012, 0.015, 0.016), roughness=0.03, specular=0.7),
        cars.TYRE: Material((0.016, 0.016, 0.016), roughness=0.85),
        cars.RIM: Material((0.50, 0.50, 0.51), roughness=0.25, metallic=0.9),
        cars.LIGHT: Material((0.75, 0.76, 0.78), roughness=0.08, metallic=0.5, specular=0.8, clearcoat=1.0),
        cars.PLATE: Material((0.75, 0.75, 0.70), roughness=0.4),
        cars.TRIM: Material((0.03, 0.03, 0.032), roughness=0.5),
        _GAP: dark,
        _TAIL_LIGHT: Material((0.42, 0.012, 0.012), roughness=0.1, specular=0.7, clearcoat=1.0),
        _SPOKE_GAP: dark,
    }
