"""Whole refinements end in the same places with native loops as without them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from benchmark_suites.workloads import demo_scene

from directshape_torch import DirectShapeRefiner, RefinementResult, load_config
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import without_kernels
from directshape_torch.scene.masks import MaskCrops

pytestmark = pytest.mark.usefixtures("no_gradients")


def check_agreement(native: RefinementResult, by_tensors: RefinementResult) -> None:
    """All cars but one end within a millimetre, with the same statuses.

    Rounding decides now and then whether a car takes one more step along a flat valley: starts that are moved by a
    ten-millionth of their distance move one car of this frame by 5 mm without native loops.
    """
    apart_m = (native.T_cam_obj[:, :3, 3] - by_tensors.T_cam_obj[:, :3, 3]).norm(dim=1)
    is_near = apart_m < 1e-3
    assert int(is_near.sum()) >= len(apart_m) - 1
    assert float(apart_m.max()) < 0.03
    pairs = zip(native.status, by_tensors.status, is_near.tolist(), strict=True)
    assert all(one is other for one, other, near in pairs if near)
    assert not torch.equal(native.T_cam_obj, by_tensors.T_cam_obj)


@pytest.mark.parametrize("changes", [[], ["rig.disparity_sigma_px=0"], ["solver.rays=marched"]])
def test_the_bundled_frame_ends_where_tensor_operations_take_it(changes: list[str]) -> None:
    """Settings have an unknown offset of the rig or none, or march the rays of each state."""
    refiner, inputs = DirectShapeRefiner(config=load_config(None, changes)), collate(demo_scene().frames)
    native = refiner(*inputs)
    with without_kernels():
        check_agreement(native, refiner(*inputs))


def test_a_frame_without_right_masks_ends_where_tensor_operations_take_it() -> None:
    frames, detections = collate(demo_scene().frames)
    nowhere = torch.zeros(len(detections), dtype=torch.bool)
    masks = MaskCrops.of(torch.zeros(len(detections), *frames.images_left.shape[2:], dtype=torch.bool), nowhere)
    detections, refiner = replace(detections, mask_right=masks), DirectShapeRefiner()
    native = refiner(frames, detections)
    with without_kernels():
        check_agreement(native, refiner(frames, detections))


def test_two_frames_in_a_call_have_the_bits_of_one_and_again() -> None:
    refiner, (loaded,) = DirectShapeRefiner(), demo_scene().frames
    alone, again, twice = (refiner(*collate(frames)) for frames in ([loaded], [loaded], [loaded, loaded]))
    assert torch.equal(alone.T_cam_obj, again.T_cam_obj)
    assert torch.equal(torch.cat([alone.T_cam_obj, alone.T_cam_obj]), twice.T_cam_obj)
    assert torch.equal(torch.cat([alone.code, alone.code]), twice.code)


def test_a_default_device_elsewhere_changes_nothing() -> None:
    refiner, inputs = DirectShapeRefiner(), collate(demo_scene().frames)
    expected = refiner(*inputs)
    with torch.device("meta"):
        found = refiner(*inputs)
    assert torch.equal(found.T_cam_obj, expected.T_cam_obj)
