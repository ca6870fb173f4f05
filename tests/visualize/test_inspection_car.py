"""The data behind the figures of a car and its residual maps are the energy's own values, in the right places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.quick_runs import IMAGES_ALONE
from helpers.synthetic_scene import masked

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.errors import InputError
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.car_figures import CarCourse, iteration_frames, sampled_pixels_of
from directshape_torch.visualize.drawing import BLUE, ORANGE, View, silhouette_mask
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement
from directshape_torch.visualize.residuals import CarResiduals, PixelResiduals, draw_residuals, residual_maps

_CAR = 1


@pytest.fixture(scope="module")
def course() -> CarCourse:
    data = demo_dataset()
    loaded = data.load(data.frame_ids[0])
    refiner = DirectShapeRefiner(config=load_config("fast", [*IMAGES_ALONE]))
    return CarCourse(loaded, trace_refinement(refiner, loaded.frame, loaded.detections), _CAR)


def test_sampled_pixels_are_those_of_the_cost_and_others_are_hidden(course: CarCourse) -> None:
    """Car 6 is partly behind car 4 in the left image."""
    assert sampled_pixels_of(course, "left")[1] == 0
    behind = CarCourse(course.loaded, course.trace, 5)
    uv, num_hidden = sampled_pixels_of(behind, "left")
    of_cost = behind.trace.residuals(0)[5].silhouette_left.uv
    assert {tuple(one) for one in uv.tolist()} == {tuple(one) for one in of_cost.astype(int).tolist()}
    assert num_hidden > 10


@pytest.mark.parametrize("number", [0, -1])
def test_residuals_of_the_pixels_make_the_costs_of_the_trace(course: CarCourse, number: int) -> None:
    trace = course.trace
    number %= len(trace)
    costs = dict(zip(trace.result.term_names, trace.costs[number, _CAR].tolist(), strict=True))
    *silhouettes, _ = trace.residuals(number)[_CAR]
    for side, pixels in zip(("left", "right"), silhouettes, strict=True):
        weight = trace.config.silhouette.weight
        assert weight * np.abs(pixels.value).mean() == pytest.approx(costs[f"silhouette_{side}"], rel=1e-5)


@pytest.mark.parametrize("side", [0, 1])
def test_silhouette_residuals_stand_where_shape_and_mask_differ(course: CarCourse, side: int) -> None:
    """The drawn shape and the energy agree on what of the mask is left empty and where the shape spills out of it."""
    pixels, d = course.trace.residuals(0)[_CAR][side], course.loaded.detections
    mask = (d.mask_left.dense(), d.mask_right.dense())[side][_CAR].numpy() > 0.5
    surface = course.cars[0].surface
    assert surface is not None
    shape = silhouette_mask(View.of_frame(course.loaded.frame, ("left", "right")[side]), surface) > 0
    u, v = pixels.uv.astype(int).T
    differ = (mask != shape)[v, u]
    assert differ.sum() > 15
    assert ((np.abs(pixels.value) > np.log(2)) == differ).mean() > 0.97
    assert ((pixels.value > 0) == ~mask[v, u]).all()
    assert not pixels.lost.any()


def test_photometric_residuals_fall_and_hardly_a_pixel_is_lost(course: CarCourse) -> None:
    before, after = (course.trace.residuals(k)[_CAR].photometric for k in (0, len(course.trace) - 1))
    assert np.array_equal(before.uv, after.uv)
    assert after.lost.mean() < 0.05
    both = ~before.lost & ~after.lost
    assert np.abs(after.value[both]).mean() < np.abs(before.value[both]).mean()
    term = course.trace.last_stage.photometric
    assert term is not None
    assert len(after.uv) == int(term.pixel_set.support[course.trace.place_of(_CAR)])
    u, v = after.uv.astype(int).T
    assert course.loaded.detections.mask_left.dense()[_CAR].numpy()[v, u].mean() > 0.9


def test_costs_end_at_those_of_the_result(course: CarCourse) -> None:
    costs, result = course.costs, course.trace.result
    assert costs["sum"][0] == pytest.approx(float(result.cost_before[_CAR].sum()), rel=1e-9)
    assert costs["sum"][-1] == pytest.approx(float(result.cost_after[_CAR].sum()), rel=2e-4)
    assert set(costs) == {*result.term_names, "sum"}


def test_animation_moves_the_contour_in_both_images(course: CarCourse) -> None:
    frames = iteration_frames(course)
    assert len(frames) == len(course.steps)
    # The images lie below the caption and the legend, the left one first.
    for number, ink in ((0, ORANGE), (-1, BLUE)):
        for left in (0, 406):
            image = frames[number][90:, left : left + 400].astype(int)
            assert (np.abs(image - ink).max(axis=-1) < 20).sum() > 200


def test_cars_that_did_not_take_part_are_refused(course: CarCourse) -> None:
    detections = course.loaded.detections
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[_CAR, 2, 3] = torch.nan
    refiner = DirectShapeRefiner(config=load_config("fast", ["stages=[{max_iterations: 1}]"]))
    trace: RefinementTrace = trace_refinement(refiner, course.loaded.frame, replace(detections, T_cam_obj=T_cam_obj))
    with pytest.raises(InputError, match="non_finite"):
        CarCourse(course.loaded, trace, _CAR)
    with pytest.raises(InputError, match="no such car"):
        CarCourse(course.loaded, trace, 99)


def at_the_end(
    course: CarCourse, loaded: LoadedFrame, shift_m: tuple[float, float, float] = (0, 0, 0), *words: str
) -> CarResiduals:
    """The residual map of a page for the car at the end of its refinement, or moved away from there."""
    result, rows = course.trace.result, torch.tensor([0, _CAR])
    T_cam_obj = result.T_cam_obj[rows].numpy().copy()
    T_cam_obj[:, :3, 3] += shift_m
    states = [(T_cam_obj, result.code[rows].numpy())]
    return residual_maps(loaded, result.prior, load_config("fast", list(words)), rows, states)[0][1]


def mean(values: PixelResiduals) -> float:
    return float(np.abs(values.value[~values.lost]).mean())


def test_values_are_those_of_the_energy(course: CarCourse) -> None:
    of_energy = course.trace.residuals(len(course.trace) - 1)[_CAR].silhouette_left
    of_map = at_the_end(course, course.loaded).silhouette_left
    known = dict(zip(map(tuple, of_map.uv.tolist()), of_map.value, strict=True))
    energy = zip(map(tuple, of_energy.uv.tolist()), of_energy.value, strict=True)
    pairs = [(value, known[place]) for place, value in energy if place in known]
    assert len(pairs) > 30
    np.testing.assert_allclose(*np.transpose(pairs), atol=1e-3)


def test_a_car_in_the_wrong_place_disagrees(course: CarCourse) -> None:
    found, behind = (at_the_end(course, course.loaded, (0, 0, metres)) for metres in (0.0, 1.0))
    assert mean(behind.photometric) > 1.4 * mean(found.photometric)
    # Moved to the right it leaves its mask's left side empty and spills out on the right.
    left = at_the_end(course, course.loaded, (0.6, 0, 0)).silhouette_left
    spilled, unfilled = np.clip(left.value, 0, None), np.clip(-left.value, 0, None)
    assert np.average(left.uv[:, 0], weights=unfilled) + 20 < np.average(left.uv[:, 0], weights=spilled)


def test_brightness_is_matched_where_the_run_matched_it(course: CarCourse) -> None:
    frame = course.loaded.frame
    dark = replace(course.loaded, frame=replace(frame, images_right=0.8 * frame.images_right))
    matched, plain = (
        mean(at_the_end(course, dark, (0, 0, 0), *words).photometric) for words in ([], ["photometric.brightness=none"])
    )
    assert plain > 2 * matched


def test_without_a_mask_there_are_none(course: CarCourse) -> None:
    detections = course.loaded.detections
    none = torch.zeros_like(detections.has_mask_left)
    found = at_the_end(course, replace(course.loaded, detections=masked(detections, none)))
    assert [len(values.uv) for values in found[::2]] == [0, 0]
    view = View.of_frame(course.loaded.frame)
    draw_residuals(view, found, "photometric")
    assert (np.ptp(view.picture.astype(int), axis=2) == 0).all()
