"""Maps of residuals at any state: the energy's own values, with the right sign and place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.drawing import View
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement
from directshape_torch.visualize.residuals import CarResiduals, PixelResiduals, draw_residuals, residual_maps

_CAR = 2
_ROWS = torch.tensor([0, _CAR])


@pytest.fixture(scope="module")
def loaded() -> LoadedFrame:
    return demo_dataset().load("000000")


@pytest.fixture(scope="module")
def trace(loaded: LoadedFrame) -> RefinementTrace:
    return trace_refinement(
        DirectShapeRefiner(config=load_config("fast", ["compile=off"])), loaded.frame, loaded.detections
    )


def at_the_end(
    loaded: LoadedFrame, trace: RefinementTrace, shift_m: tuple[float, float, float] = (0, 0, 0), *words: str
) -> CarResiduals:
    T_cam_obj = trace.result.T_cam_obj[_ROWS].numpy().copy()
    T_cam_obj[:, :3, 3] += shift_m
    states, config = [(T_cam_obj, trace.result.code[_ROWS].numpy())], load_config("fast", list(words))
    return residual_maps(loaded, trace.result.prior, config, _ROWS, states)[0][1]


def mean(values: PixelResiduals) -> float:
    return float(np.abs(values.value[~values.lost]).mean())


def test_values_are_those_of_the_energy(loaded: LoadedFrame, trace: RefinementTrace) -> None:
    of_energy, of_map = trace.residuals(len(trace) - 1)[_CAR].silhouette_left, at_the_end(loaded, trace).silhouette_left
    known = dict(zip(map(tuple, of_map.uv.tolist()), of_map.value, strict=True))
    energy = zip(map(tuple, of_energy.uv.tolist()), of_energy.value, strict=True)
    pairs = [(value, known[place]) for place, value in energy if place in known]
    assert len(pairs) > 30
    np.testing.assert_allclose(*np.transpose(pairs), atol=1e-3)


def test_a_car_in_the_wrong_place_disagrees(loaded: LoadedFrame, trace: RefinementTrace) -> None:
    found, behind = at_the_end(loaded, trace), at_the_end(loaded, trace, (0, 0, 1.0))
    assert mean(behind.photometric) > 1.4 * mean(found.photometric)
    # Moved to the right it leaves its mask's left side empty and spills out on the right.
    left = at_the_end(loaded, trace, (0.6, 0, 0)).silhouette_left
    spilled, unfilled = np.clip(left.value, 0, None), np.clip(-left.value, 0, None)
    assert np.average(left.uv[:, 0], weights=unfilled) + 20 < np.average(left.uv[:, 0], weights=spilled)


def test_brightness_is_matched_where_the_run_matched_it(loaded: LoadedFrame, trace: RefinementTrace) -> None:
    frame = replace(loaded.frame, images_right=0.8 * loaded.frame.images_right)
    dark = replace(loaded, frame=frame)
    matched, plain = (
        mean(at_the_end(dark, trace, (0, 0, 0), *words).photometric) for words in ([], ["photometric.brightness=none"])
    )
    assert plain > 2 * matched


def test_without_a_mask_there_are_none(loaded: LoadedFrame, trace: RefinementTrace) -> None:
    none = torch.zeros_like(loaded.detections.has_mask_left)
    blind = replace(loaded, detections=replace(loaded.detections, has_mask_left=none))
    found = at_the_end(blind, trace)
    assert [len(values.uv) for values in found[::2]] == [0, 0]
    view = View.of_frame(loaded.frame)
    draw_residuals(view, found, "photometric")
    assert (np.ptp(view.picture.astype(int), axis=2) == 0).all()
