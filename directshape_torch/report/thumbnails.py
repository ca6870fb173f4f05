"""Small pictures of each car with its contour, before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from directshape_torch.io.run_folder import FrameResult
from directshape_torch.report.car_rows import is_refined
from directshape_torch.report.drawn_frame import CarState
from directshape_torch.report.frame_inputs import FrameInputs
from directshape_torch.report.frame_material import DrawnCars
from directshape_torch.report.pictures import Window, car_window, data_url
from directshape_torch.visualize.drawing import BLUE, GREY, ORANGE, Colour, Picture, View, draw_box, draw_contour

_WIDTH_PX = 260
_LARGEST_SCALE = 4.0


def thumbnails(inputs: FrameInputs, cars: DrawnCars, result: FrameResult) -> list[dict[str, str]]:
    """For each car its pictures "before" and "after" as data URLs; nothing where the image does not show it."""
    if inputs.image_left is None or inputs.camera is None:
        return [{} for _ in cars.after]
    K = inputs.camera.K_left[0].double().numpy()
    pictures: list[dict[str, str]] = []
    for car, status in enumerate(result.shapes.statuses):
        states = cars.states(car)
        window = window_of_states(inputs.image_left, K, list(states.values()))
        colours = {"before": ORANGE, "after": BLUE if is_refined(status) else GREY}
        pictures.append(
            {
                name: data_url(_thumbnail(inputs.image_left, K, window, state, colours[name]))
                for name, state in states.items()
                if window is not None
            }
        )
    return pictures


def _thumbnail(image: Picture, K: npt.NDArray[np.float64], window: Window, state: CarState, colour: Colour) -> Picture:
    scale = min(_WIDTH_PX / (window[2] - window[0]), _LARGEST_SCALE)
    view = View.of_window(image, K, window, scale)
    surface = state.surface
    if surface is None:
        draw_box(view, state.corners_cam, colour)
    else:
        draw_contour(view, surface, colour, 2)
    return view.picture


def window_of_states(image: Picture, K: npt.NDArray[np.float64], states: Sequence[CarState]) -> Window | None:
    """The part of the image that shows a car in all of its states, or None where it shows none."""
    return car_window(image, K, np.concatenate([state.corners_cam for state in states]))
