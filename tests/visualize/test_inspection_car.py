"""The data behind the figures of a car against the refinement itself and against geometry by hand."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.io.config_files import load_config
from directshape_torch.observation.packing import pack_pixels
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.car_figures import animation_frames, costs_of_car, sampled_pixels_of
from directshape_torch.visualize.car_view import CarView
from directshape_torch.visualize.refinement_trace import RefinementTrace, car_residuals, trace_refinement

_CAR = 1


@pytest.fixture(scope="module")
def view() -> CarView:
    data = demo_dataset()
    loaded = data.load(data.frame_ids[0])
    refiner = DirectShapeRefiner(config=load_config("fast", ["compile=off"]))
    return CarView(loaded, trace_refinement(refiner, loaded.frame, loaded.detections), _CAR)


@pytest.mark.parametrize("side", ["left", "right"])
def test_contour_points_lie_on_the_zero_level_of_the_projected_distance(view: CarView, side: str) -> None:
    lines = view.contours(side, len(view.trace) - 1)
    assert lines
    uv = torch.from_numpy(np.concatenate(lines)).float()[::7]
    # The least distance along each ray, by brute force.
    camera = view.loaded.frame.camera
    K = camera.K_left[0] if side == "left" else camera.K_right[0]
    ray = torch.cat([uv, torch.ones(len(uv), 1)], dim=1) @ torch.linalg.inv(K).T
    origin = torch.zeros(3) if side == "left" else -camera.T_right_cam[0, :3, 3]
    state = view.state(len(view.trace) - 1)
    centre = se3.inverse(state.T_obj_cam)[0, 2, 3]
    depth = torch.linspace(float(centre) - 4, float(centre) + 4, 1601)
    points_cam = origin + depth[:, None, None] * ray
    points_obj = points_cam.reshape(-1, 3) @ state.T_obj_cam[0, :3, :3].T + state.T_obj_cam[0, :3, 3]
    low, high = view.prior.bounds_obj
    inside = ((points_obj > low) & (points_obj < high)).all(dim=1)
    sdf = view.prior.bind(state.code).value(points_obj, torch.zeros(len(points_obj), dtype=torch.long))
    least = torch.where(inside, sdf, torch.inf).view(len(depth), -1).amin(dim=0)
    metres_per_px = float(centre) / float(K[0, 0])
    assert least.abs().max() < 0.25 * metres_per_px


@pytest.mark.parametrize("side", ["left", "right"])
def test_sampled_pixels_are_those_of_the_observation(view: CarView, side: str) -> None:
    seen = pack_pixels(view.loaded.frame, view.loaded.detections, view.trace.config.sampling)
    pixels = seen.left if side == "left" else seen.right
    expected = pixels.uv[pixels.object_index == _CAR].long().numpy()
    uv, _, mode = sampled_pixels_of(view, side)
    assert {tuple(one) for one in uv.tolist()} == {tuple(uv) for uv in expected.tolist()}
    # `fast` has evenly spaced pixels in the right image.
    assert mode == ("adaptive" if side == "left" else "uniform")


@pytest.mark.parametrize("number", [0, -1])
def test_residuals_of_the_pixels_make_the_costs_of_the_trace(view: CarView, number: int) -> None:
    trace = view.trace
    number %= len(trace)
    costs = dict(zip(trace.result.term_names, trace.costs[number, _CAR].tolist(), strict=True))
    *silhouettes, _ = car_residuals(trace, number)[_CAR]
    for side, pixels in zip(("left", "right"), silhouettes, strict=True):
        weight = trace.config.silhouette.weight
        assert weight * pixels.value.mean() == pytest.approx(costs[f"silhouette_{side}"], rel=1e-5)


@pytest.mark.parametrize("side", [0, 1])
def test_silhouette_residuals_stand_where_shape_and_mask_differ(view: CarView, side: int) -> None:
    pixels, d = car_residuals(view.trace, 0)[_CAR][side], view.loaded.detections
    mask = (d.mask_left, d.mask_right)[side][_CAR].numpy() > 0.5
    shape = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(shape, [np.round(line).astype(np.int32) for line in view.contours(("left", "right")[side], 0)], 1)
    u, v = pixels.uv.astype(int).T
    differ = (mask != (shape > 0))[v, u]
    assert differ.sum() > 15
    assert ((pixels.value > np.log(2)) == differ).mean() > 0.97
    assert not pixels.lost.any()


def test_photometric_residuals_fall_and_hardly_a_pixel_is_lost(view: CarView) -> None:
    before, after = (car_residuals(view.trace, k)[_CAR].photometric for k in (0, len(view.trace) - 1))
    assert np.array_equal(before.uv, after.uv)
    assert after.lost.mean() < 0.05
    both = ~before.lost & ~after.lost
    assert np.abs(after.value[both]).mean() < np.abs(before.value[both]).mean()
    term = view.trace.last_stage.photometric
    assert term is not None
    assert len(after.uv) == int(term.pixel_set.support[view.trace.place_of(_CAR)])
    u, v = after.uv.astype(int).T
    assert view.loaded.detections.mask_left[_CAR].numpy()[v, u].mean() > 0.9


def test_costs_end_at_those_of_the_result(view: CarView) -> None:
    costs, result = costs_of_car(view), view.trace.result
    assert costs["sum"][0] == pytest.approx(float(result.cost_before[_CAR].sum()), rel=1e-9)
    assert costs["sum"][-1] == pytest.approx(float(result.cost_after[_CAR].sum()), rel=2e-4)
    assert set(costs) == {*result.term_names, "sum"}


def test_animation_moves_the_contour_in_both_images(view: CarView) -> None:
    frames = animation_frames(view)
    assert len(frames) == len(view.steps)
    # Without the caption, whose number changes.
    first, last = (frame[frame.shape[0] // 6 :].astype(int) for frame in (frames[0], frames[-1]))
    moved = np.abs(last - first).max(axis=(0, 2)) > 100
    # The images take more than half of the width, the left one first.
    width = frames[0].shape[1]
    assert moved[: width * 3 // 10].any()
    assert moved[width * 32 // 100 : width * 55 // 100].any()


def test_cars_that_did_not_take_part_are_refused(view: CarView) -> None:
    detections = view.loaded.detections
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[_CAR, 2, 3] = torch.nan
    refiner = DirectShapeRefiner(config=load_config("fast", ["compile=off", "stages=[{max_iterations: 1}]"]))
    trace: RefinementTrace = trace_refinement(refiner, view.loaded.frame, replace(detections, T_cam_obj=T_cam_obj))
    with pytest.raises(InputError, match="non_finite"):
        CarView(view.loaded, trace, _CAR)
    with pytest.raises(InputError, match="no such car"):
        CarView(view.loaded, trace, 99)
