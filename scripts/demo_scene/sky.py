"""This module makes a sky of thin clouds as a latitude-longitude radiance map; the sun is a separate light."""

from __future__ import annotations

import cv2
import numpy as np

from demo_scene.camera import Array
from demo_scene.noise import fractal_noise


def sky_radiance(rng: np.random.Generator, sun_direction_up: Array) -> Array:
    """Linear RGB radiance (512, 1024, 3); row 0 is the zenith, the middle row the horizon.

    Args:
        rng: source of the clouds.
        sun_direction_up: unit vector (3,) towards the sun in the map's own frame (y up).
    """
    height, width = 512, 1024
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi
    # In the renderer's convention u = 0 looks along +z and u grows towards +x, mirrored, as in `atan2(x, -z)`.
    direction = np.stack(
        [
            np.sin(polar)[:, None] * np.sin(azimuth)[None, :],
            np.broadcast_to(np.cos(polar)[:, None], (height, width)),
            -np.sin(polar)[:, None] * np.cos(azimuth)[None, :],
        ],
        axis=-1,
    )
    elevation = np.clip(direction[..., 1:2], 0.0, 1.0)
    zenith, horizon = np.array([0.16, 0.32, 0.70]), np.array([0.62, 0.74, 0.92])
    blue = horizon + (zenith - horizon) * elevation**0.45
    toward_sun = np.clip(direction @ sun_direction_up, 0.0, 1.0)[..., None]
    blue = blue + np.array([1.0, 0.93, 0.8]) * (0.5 * toward_sun**24 + 3.0 * toward_sun**400)
    cover = _cloud_cover(rng, direction)[..., None]
    cloud = np.array([1.0, 1.0, 1.02]) * (0.95 + 0.5 * toward_sun**6)
    sky = (1 - cover) * blue + cover * cloud
    ground = np.array([0.16, 0.15, 0.14])
    return np.asarray(np.where(direction[..., 1:2] > 0.0, sky, ground))


def _cloud_cover(rng: np.random.Generator, direction: Array) -> Array:
    """Clouds on a flat layer, which grow towards the zenith and crowd at the horizon."""
    size = 1024
    layer = fractal_noise(rng, size, size, 180.0, 3.0)
    height = np.clip(direction[..., 1], 0.04, None)
    u = size / 2 + 150.0 * direction[..., 0] / height
    v = size / 2 + 150.0 * direction[..., 2] / height
    sampled = cv2.remap(layer.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR,
                        borderMode=cv2.BORDER_REFLECT)  # fmt: skip
    cover = np.clip(0.9 * (sampled - 0.15), 0.0, 1.0)
    fade = np.clip((direction[..., 1] - 0.02) / 0.12, 0.0, 1.0)
    return np.asarray(cover * fade * 0.9)
