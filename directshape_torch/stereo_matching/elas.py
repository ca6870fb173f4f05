"""Dense disparity by ELAS (Geiger, Roser, Urtasun, ACCV 2010), the matcher of Engelmann et al., if it is installed."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import MissingDependencyError
from directshape_torch.stereo_matching.disparity import check_pair


def match_disparity_elas(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
) -> NDArray[np.float32]:  # (H, W)
    """Disparity of each left pixel, `u_left - u_right`, with libelas' own settings for robots.

    Returns:
        pixels, NaN where unknown.

    Raises:
        MissingDependencyError: the package pyelas (GPL-3.0, hence never installed by default) is not there.
        InputError: the images are not a pair of RGB uint8 images.
    """
    import cv2

    check_pair(image_left, image_right)
    matcher = _elas_module().Elas()
    left, right = (
        np.ascontiguousarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
        for image in (image_left, image_right)
    )
    disparity = np.array(matcher.process(left, right)[0], dtype=np.float32)
    disparity[disparity <= 0] = np.nan
    return disparity


def _elas_module() -> Any:
    try:
        return importlib.import_module("elas")
    except ImportError as error:
        raise MissingDependencyError(
            "pyelas",
            "elas",
            "point_cloud.matcher elas (GPL-3.0, built from source)",
            # Its source does not find numpy's headers by itself.
            environment=f"CPLUS_INCLUDE_PATH={np.get_include()}",
        ) from error
