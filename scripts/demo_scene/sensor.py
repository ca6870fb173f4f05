"""This module turns noisy linear radiance into camera images: denoising, exposure, tone curve, gain, sensor noise."""

from __future__ import annotations

import cv2
import numpy as np

from demo_scene.camera import Array
from demo_scene.rendering import PathTraced
from demo_scene.surfaces import Picture
from directshape_torch.errors import MissingDependencyError

_NOISE_GREY_LEVELS = 1.2


def denoise(view: PathTraced) -> Array:
    """Radiance (H, W, 3) without path-tracing noise, by Open Image Denoise.

    Raises:
        MissingDependencyError: Open Image Denoise is not installed.
    """
    try:
        import pyoidn
    except ImportError as error:
        raise MissingDependencyError("pyoidn", "render", "rendering") from error
    radiance, albedo, normals = (
        np.ascontiguousarray(a, dtype=np.float32) for a in (view.radiance, view.albedo, np.clip(view.normals, -1, 1))
    )
    return np.asarray(pyoidn.denoise(radiance, albedo, normals, hdr=True), dtype=np.float64)


def exposure_for(radiance: Array) -> float:
    """Factor that brings the street, the lower half of the picture, to a medium grey."""
    luminance = radiance[len(radiance) // 2 :] @ np.array([0.299, 0.587, 0.114])
    return 0.19 / max(float(np.median(luminance)), 1e-6)


def develop(rng: np.random.Generator, radiance: Array, exposure: float, gain: float) -> Picture:
    """The camera's picture (H, W, 3), RGB bytes: a filmic shoulder, sRGB, a little blur, shot and read noise."""
    linear = np.maximum(exposure * gain * radiance, 0.0)
    shoulder = linear * (1.0 + linear / 9.0) / (1.0 + linear / 1.6)
    linear = np.minimum(1.28 * shoulder, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    srgb = cv2.GaussianBlur(srgb, (0, 0), 0.45)
    noise = rng.standard_normal(srgb.shape) * _NOISE_GREY_LEVELS * (0.6 + 0.8 * np.sqrt(np.clip(srgb, 0, 1)))
    return np.clip(np.rint(255.0 * srgb + noise), 0, 255).astype(np.uint8)
