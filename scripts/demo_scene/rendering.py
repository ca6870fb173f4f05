"""This module renders a scene by path tracing with Mitsuba 3, with exact instance and depth maps at pixel centres.

It needs the extra `render` (mitsuba, pyoidn). The variant `scalar_rgb` runs as installed; `llvm_ad_rgb` is faster and
needs an LLVM library of version 19 (Debian: `apt-get install libllvm19`), because older ones crash.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from demo_scene.camera import IMAGE_HEIGHT_PX, IMAGE_WIDTH_PX, Array, K
from demo_scene.surfaces import Indices, Material, Picture, Surface
from directshape_torch.errors import MissingDependencyError

_MAX_RADIANCE = 12.0
_MAX_INSTANCES = 64


@dataclass(frozen=True)
class Light:
    """A `Light` has the sky's radiance map, the unit direction (3,) to the sun in the road frame, its irradiance."""

    sky_radiance: Array
    direction_to_sun: Array
    sun_irradiance_rgb: tuple[float, float, float]


@dataclass(frozen=True)
class PathTraced:
    """A `PathTraced` has linear radiance, albedo and normals (H, W, 3) of one view, with noise."""

    radiance: Array
    albedo: Array
    normals: Array


@dataclass(frozen=True)
class PixelTruth:
    """A `PixelTruth` says what the ray through each pixel's centre hits first."""

    instance: Indices  # (H, W) number of the car, -1 for the street and the sky
    depth_m: Array  # (H, W) distance along the optical axis, 0 for the sky


def import_mitsuba() -> Any:
    """The renderer's module.

    Raises:
        MissingDependencyError: Mitsuba is not installed.
    """
    try:
        return importlib.import_module("mitsuba")
    except ImportError as error:
        raise MissingDependencyError("mitsuba", "render", "rendering") from error


class Renderer:
    """A `Renderer` is Mitsuba with one loaded scene.

    Args:
        surfaces: all visible surfaces.
        light: sky and sun for `path_trace`; None for `pixel_truth`, where materials do not matter.
        variant: Mitsuba's variant.
    """

    def __init__(self, surfaces: list[Surface], light: Light | None, variant: str = "scalar_rgb") -> None:
        mitsuba = import_mitsuba()
        mitsuba.set_variant(variant)
        self._mi: Any = mitsuba
        self._shows_instances = light is None
        description: dict[str, Any] = {"type": "scene"}
        if light is not None:
            description |= self._lights(light)
        for k, surface in enumerate(surfaces):
            description[f"surface_{k:04d}"] = self._mesh(f"surface_{k:04d}", surface)
        self._scene = mitsuba.load_dict(description, optimize=False)

    def path_trace(self, T_view_road: Array, paths_per_pixel: int, seed: int) -> PathTraced:
        """Radiance seen by a camera, with the albedo and normals that the denoiser needs."""
        integrator = {
            "type": "aov",
            "aovs": "albedo:albedo,normal:sh_normal",
            "path": {"type": "path", "max_depth": 6},
        }
        sampler = {"type": "independent", "sample_count": paths_per_pixel}
        channels = self._render(T_view_road, integrator, sampler, seed)
        radiance = np.minimum(np.nan_to_num(channels[..., :3]), _MAX_RADIANCE)
        return PathTraced(radiance, np.clip(channels[..., -6:-3], 0.0, 1.0), channels[..., -3:])

    def pixel_truth(self, T_view_road: Array) -> PixelTruth:
        """Instance and depth at the first hits of the rays through the pixel centres."""
        integrator = {"type": "aov", "aovs": "instance:albedo,position:position"}
        # One stratified sample without jitter is at the centre of its pixel.
        sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
        channels = self._render(T_view_road, integrator, sampler, 0)
        instance = np.rint(channels[..., -6] * _MAX_INSTANCES).astype(np.int64) - 1
        points_road = channels[..., -3:]
        depth = points_road @ T_view_road[2, :3] + T_view_road[2, 3]
        hit = np.abs(points_road).sum(axis=-1) > 0.0
        return PixelTruth(instance, np.where(hit, depth, 0.0))

    def _render(self, T_view_road: Array, integrator: dict[str, Any], sampler: dict[str, Any], seed: int) -> Array:
        sensor = self._mi.load_dict(self._sensor(T_view_road, sampler))
        image = self._mi.render(self._scene, sensor=sensor, integrator=self._mi.load_dict(integrator), seed=seed)
        return np.array(image, dtype=np.float64)

    def _sensor(self, T_view_road: Array, sampler: dict[str, Any]) -> dict[str, Any]:
        # Mitsuba looks along +z with x to the left and y up.
        to_world = np.linalg.inv(T_view_road) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        return {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(0.5 * IMAGE_WIDTH_PX / K[0, 0]))),
            "near_clip": 0.05,
            "far_clip": 1000.0,
            "to_world": self._mi.ScalarTransform4f(to_world),
            # The film's continuous coordinates have the centre of the first pixel at 0.5, ours at 0; its axes point
            # left and up.
            "principal_point_offset_x": float((0.5 * IMAGE_WIDTH_PX - K[0, 2] - 0.5) / IMAGE_WIDTH_PX),
            "principal_point_offset_y": float((0.5 * IMAGE_HEIGHT_PX - K[1, 2] - 0.5) / IMAGE_HEIGHT_PX),
            "film": {
                "type": "hdrfilm",
                "width": IMAGE_WIDTH_PX,
                "height": IMAGE_HEIGHT_PX,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": sampler,
        }

    def _lights(self, light: Light) -> dict[str, Any]:
        # The map has +y up, the road -y.
        upright = self._mi.ScalarTransform4f().rotate([1, 0, 0], 180.0)
        bitmap = self._mi.Bitmap(light.sky_radiance.astype(np.float32))
        sun = {
            "type": "directional",
            "direction": [float(-c) for c in light.direction_to_sun],
            "irradiance": {"type": "rgb", "value": list(light.sun_irradiance_rgb)},
        }
        return {"sky": {"type": "envmap", "bitmap": bitmap, "to_world": upright}, "sun": sun}

    def _mesh(self, name: str, surface: Surface) -> Any:
        properties = self._mi.Properties()
        properties["material"] = self._mi.load_dict(self._bsdf(surface))
        mesh = self._mi.Mesh(
            name,
            len(surface.vertices),
            len(surface.faces),
            has_vertex_normals=surface.normals is not None,
            has_vertex_texcoords=surface.uv is not None,
            props=properties,
        )
        if surface.colors is not None:
            mesh.add_attribute("vertex_color", 3, surface.colors.astype(np.float32).ravel())
        values = {
            "vertex_positions": surface.vertices,
            "vertex_normals": surface.normals,
            "vertex_texcoords": surface.uv,
        }
        parameters = self._mi.traverse(mesh)
        parameters["faces"] = surface.faces.astype(np.uint32).ravel()
        for key, value in values.items():
            if value is not None:
                parameters[key] = value.astype(np.float32).ravel()
        parameters.update()
        return mesh

    def _bsdf(self, surface: Surface) -> dict[str, Any]:
        if self._shows_instances:
            # The car's number is a grey albedo, because shape indices count all scenes of the process.
            grey = (surface.instance + 1) / _MAX_INSTANCES
            reflectance = {"type": "rgb", "value": [grey, grey, grey]}
            return {"type": "twosided", "material": {"type": "diffuse", "reflectance": reflectance}}
        return {"type": "twosided", "material": self._principled(surface.material)}

    def _principled(self, material: Material) -> dict[str, Any]:
        base = material.base_color
        if base is None:
            color: Any = {"type": "mesh_attribute", "name": "vertex_color"}
        elif isinstance(base, tuple):
            color = {"type": "rgb", "value": list(base)}
        else:
            color = self._bitmap(base, raw=False)
        roughness = material.roughness
        return {
            "type": "principled",
            "base_color": color,
            "roughness": roughness if isinstance(roughness, float) else self._bitmap(roughness, raw=True),
            "metallic": material.metallic,
            "specular": material.specular,
            "clearcoat": material.clearcoat,
            "clearcoat_gloss": 0.97,
        }

    def _bitmap(self, picture: Picture, raw: bool) -> dict[str, Any]:
        bitmap = self._mi.Bitmap(np.ascontiguousarray(picture if picture.ndim == 3 else picture[..., None]))
        return {"type": "bitmap", "bitmap": bitmap, "raw": raw, "wrap_mode": "clamp"}
