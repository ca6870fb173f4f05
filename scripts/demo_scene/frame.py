"""One frame from its seed: layout, surfaces, both views, exact masks, labels and detections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from demo_scene import sensor
from demo_scene.camera import Array
from demo_scene.car_surfaces import car_model, car_surfaces
from demo_scene.frame_files import Frame
from demo_scene.labels import StereoNoise, noisy_detection, true_label
from demo_scene.layout import SceneLayout
from demo_scene.rendering import Light, PixelTruth, Renderer
from demo_scene.sky import sky_radiance
from demo_scene.street import street
from demo_scene.surfaces import Surface

_RIGHT_GAIN_DEVIATION = 0.02


@dataclass(frozen=True)
class RenderSettings:
    """How much effort a frame gets; `scale` below 1 gives a small picture, for a look only."""

    paths_per_pixel: int = 16
    variant: str = "scalar_rgb"
    scale: float = 1.0


def render_frame(layout: SceneLayout, settings: RenderSettings) -> Frame:
    """Render a scene; randomness comes from `layout.seed` alone."""
    rngs = dict(zip(("street", "sky", "sensor", "detector"), _generators(layout.seed, 4), strict=True))
    models = [car_model(car) for car in layout.cars]
    car_parts = [car_surfaces(c, m, k) for k, (c, m) in enumerate(zip(layout.cars, models, strict=True))]
    surfaces = street(rngs["street"]) + [surface for parts in car_parts for surface in parts]
    renderer = Renderer(surfaces, scene_light(rngs["sky"], layout), settings.variant)
    views = (layout.camera.T_cam_road, layout.camera.T_right_road)
    radiance = [
        sensor.denoise(renderer.path_trace(view, settings.paths_per_pixel, 2 * layout.seed + k, settings.scale))
        for k, view in enumerate(views)
    ]
    exposure = sensor.exposure_for(radiance[0])
    gains = (1.0, float(np.exp(_RIGHT_GAIN_DEVIATION * rngs["sensor"].standard_normal())))
    left, right = (
        sensor.develop(rngs["sensor"], picture, exposure, gain) for picture, gain in zip(radiance, gains, strict=True)
    )
    truth = Renderer(surfaces, None, settings.variant)
    truth_left, truth_right = (truth.pixel_truth(view) for view in views)
    shares = _visible_shares(layout, car_parts, truth_left, settings.variant)
    labels = tuple(
        true_label(layout.camera, car, model.vertices, share)
        for car, model, share in zip(layout.cars, models, shares, strict=True)
    )
    detections = tuple(noisy_detection(rngs["detector"], label, StereoNoise()) for label in labels)
    return Frame(layout, left, right, truth_left.instance, truth_right.instance, labels, detections)


def scene_light(rng: np.random.Generator, layout: SceneLayout) -> Light:
    """Sky and sun of a scene."""
    elevation, azimuth = layout.sun_elevation_rad, layout.sun_azimuth_rad
    to_sun = np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    # The sky map's frame is the road's turned by 180 degrees about x.
    to_sun_map = to_sun * np.array([1.0, -1.0, -1.0])
    return Light(sky_radiance(rng, to_sun_map), to_sun, (3.6, 3.3, 2.9))


def _generators(seed: int, count: int) -> list[np.random.Generator]:
    # Streams of their own: more detail in the street must not move the detections.
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]


def _visible_shares(layout: SceneLayout, car_parts: list[list[Surface]], truth: PixelTruth, variant: str) -> Array:
    """Visible pixels of each car over its pixels when it stands alone."""
    shares = []
    for k, parts in enumerate(car_parts):
        alone = Renderer(parts, None, variant).pixel_truth(layout.camera.T_cam_road)
        shares.append((truth.instance == k).sum() / max((alone.instance == k).sum(), 1))
    return np.array(shares)
