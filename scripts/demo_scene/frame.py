"""This module renders frames from a seed: layout, surfaces, both views, exact masks, labels and detections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from parametric_cars.surfaces import car_mesh

from demo_scene import sensor
from demo_scene.camera import Array, transform
from demo_scene.car_surfaces import car_surfaces
from demo_scene.frame_files import Frame
from demo_scene.labels import CarLabel, noisy_detection, true_label
from demo_scene.layout import SceneLayout
from demo_scene.rendering import Light, PixelTruth, Renderer
from demo_scene.sky import sky_radiance
from demo_scene.street import street
from demo_scene.surfaces import Picture, Surface

if TYPE_CHECKING:
    import trimesh

_RIGHT_GAIN_DEVIATION = 0.02
# A car gets a label if it has this many visible pixels, and all of it is this far in front of the camera.
_FEWEST_PIXELS, _NEAREST_M = 300, 0.8


@dataclass(frozen=True)
class RenderSettings:
    """A `RenderSettings` sets the effort for a frame."""

    paths_per_pixel: int = 16
    variant: str = "scalar_rgb"


def render_frame(layout: SceneLayout, settings: RenderSettings) -> Frame:
    """Render a scene, with all randomness from `layout.seed`."""
    return next(render_sequence([layout], settings))


def render_sequence(layouts: Sequence[SceneLayout], settings: RenderSettings) -> Iterator[Frame]:
    """Render one scene at several times; the street and the cars' surfaces are made once."""
    first = layouts[0]
    rngs = dict(zip(("street", "sky", "sensor", "detector"), _generators(first.seed, 4), strict=True))
    still, light = street(rngs["street"]), scene_light(rngs["sky"], first)
    meshes = [car_mesh(car.parameters) for car in first.cars]
    for number, layout in enumerate(layouts):
        car_parts = [car_surfaces(c, m, k) for k, (c, m) in enumerate(zip(layout.cars, meshes, strict=True))]
        surfaces = still + [surface for parts in car_parts for surface in parts]
        left, right = _pictures(Renderer(surfaces, light, settings.variant), layout, number, rngs["sensor"], settings)
        truth = Renderer(surfaces, None, settings.variant)
        truth_left, truth_right = (truth.pixel_truth(view) for view in _views(layout))
        labels = _labels(layout, meshes, car_parts, truth_left, settings.variant)
        detections = {k: noisy_detection(rngs["detector"], label) for k, label in labels.items()}
        yield Frame(layout, left, right, truth_left.instance, truth_right.instance, labels, detections)


def _views(layout: SceneLayout) -> tuple[Array, Array]:
    return layout.camera.T_cam_road, layout.camera.T_right_road


def _pictures(
    renderer: Renderer, layout: SceneLayout, number: int, rng: np.random.Generator, settings: RenderSettings
) -> tuple[Picture, Picture]:
    seed = 2 * (layout.seed + number)
    radiance = [
        sensor.denoise(renderer.path_trace(view, settings.paths_per_pixel, seed + k))
        for k, view in enumerate(_views(layout))
    ]
    exposure = sensor.exposure_for(radiance[0])
    gain = float(np.exp(_RIGHT_GAIN_DEVIATION * rng.standard_normal()))
    return sensor.develop(rng, radiance[0], exposure, 1.0), sensor.develop(rng, radiance[1], exposure, gain)


def _labels(
    layout: SceneLayout,
    meshes: Sequence[trimesh.Trimesh],
    car_parts: list[list[Surface]],
    truth: PixelTruth,
    variant: str,
) -> dict[int, CarLabel]:
    """Labels of the visible cars, by their number."""
    labels = {}
    for k, (car, mesh) in enumerate(zip(layout.cars, meshes, strict=True)):
        pixels = int((truth.instance == k).sum())
        vertices = np.asarray(mesh.vertices)
        depths = transform(layout.camera.T_cam_road @ car.T_road_obj, vertices)[:, 2]
        if pixels >= _FEWEST_PIXELS and depths.min() > _NEAREST_M:
            alone = Renderer(car_parts[k], None, variant).pixel_truth(layout.camera.T_cam_road)
            share = pixels / int((alone.instance == k).sum())
            labels[k] = true_label(layout.camera, car, vertices, share)
    return labels


def scene_light(rng: np.random.Generator, layout: SceneLayout) -> Light:
    """Sky and sun of a scene."""
    elevation, azimuth = layout.sun_elevation_rad, layout.sun_azimuth_rad
    to_sun = np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    # The sky map's frame is the road's rotated by 180 degrees about x.
    to_sun_map = to_sun * np.array([1.0, -1.0, -1.0])
    return Light(sky_radiance(rng, to_sun_map), to_sun, (3.6, 3.3, 2.9))


def _generators(seed: int, count: int) -> list[np.random.Generator]:
    # Each part has its own stream, so that more detail in the street does not change the detections.
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]
