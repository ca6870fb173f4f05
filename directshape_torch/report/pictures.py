"""Pictures of a page as data URLs, and the window of the image that shows a car."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from directshape_torch.visualize.drawing import NEAR_PLANE_M, Array, Picture, View

Window = tuple[int, int, int, int]

_FRAME_QUALITY, _SMALL_QUALITY = 80, 85


def data_url(picture: Picture, quality: int = _SMALL_QUALITY) -> str:
    """A picture (h, w, 3) as WebP in a data URL.

    Raises:
        OSError: OpenCV cannot encode it.

    Examples:
        >>> data_url(np.zeros((4, 6, 3), np.uint8)).split(",")[0]
        'data:image/webp;base64'
    """
    encoded, content = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not encoded:
        raise OSError(f"cannot encode a picture of shape {picture.shape} as WebP")
    return "data:image/webp;base64," + base64.b64encode(content.tobytes()).decode("ascii")


def frame_url(image: Picture) -> str:
    """The whole image of a frame, a little smaller in bytes than `data_url`."""
    return data_url(image, _FRAME_QUALITY)


def car_window(
    image: Picture,
    K: Array,  # (3, 3)
    points_cam: Array,  # (N, 3) metres
    least_aspect: float = 1.2,
) -> Window | None:
    """The part (u_min, v_min, u_max, v_max), half open, of the image around some points, within the image.

    Returns:
        None where the image does not show them.

    Examples:
        >>> K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        >>> car_window(np.zeros((100, 100, 3), np.uint8), K, np.array([[-1.0, -1, 10], [1, 1, 10]]))
        (35, 38, 65, 62)
    """
    visible = points_cam[points_cam[:, 2] > NEAR_PLANE_M]
    height, width = image.shape[:2]
    if not len(visible):
        return None
    pixels = np.clip(View(image, K).project(visible), 0, [width - 1, height - 1])
    (u0, v0), (u1, v1) = pixels.min(axis=0), pixels.max(axis=0)
    if u1 - u0 < 1 or v1 - v0 < 1:
        return None
    tall = 1.2 * (v1 - v0) + 1
    wide = max(1.2 * (u1 - u0) + 4, least_aspect * tall)
    u, v = (u0 + u1) / 2, (v0 + v1) / 2
    corners = (round(u - wide / 2), round(v - tall / 2), round(u + wide / 2), round(v + tall / 2))
    return max(corners[0], 0), max(corners[1], 0), min(corners[2], width), min(corners[3], height)
