"""A detector's tensors are refined without files or conversions by the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch import (
    Detections,
    DirectShapeRefiner,
    FrameBatch,
    InputError,
    StereoCamera,
)
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.numerics.records import TensorRecord

PRIOR, STREET = cached_street()


def from_boxes(**changes: object) -> Detections:
    d = STREET.detections
    boxes = poses_to_boxes(d.T_cam_obj, d.dimensions_hwl, "opencv")
    masks = {"mask_left": d.mask_left.dense(), "mask_right": d.mask_right.dense()}
    return Detections.from_boxes(boxes, "opencv", **(masks | changes))


def test_tensors_alone_give_what_the_records_give() -> None:
    frame, d = STREET.frames, STREET.detections
    camera = StereoCamera.from_intrinsics(frame.camera.K_left[0], float(frame.camera.baseline[0]))
    frames = FrameBatch.from_images(frame.images_left[0], frame.images_right[0], camera, frame.ground)
    a = DirectShapeRefiner(PRIOR)(frames, from_boxes(box_2d=d.box_2d))
    b = DirectShapeRefiner(PRIOR)(replace(frame, camera=camera), d)
    assert a.status == b.status
    torch.testing.assert_close(a.T_cam_obj, b.T_cam_obj, atol=1e-6, rtol=0)


def test_intrinsics_of_one_and_of_many_frames() -> None:
    K = STREET.frames.camera.K_left[0]
    assert StereoCamera.from_intrinsics(K, 0.5).baseline.tolist() == [0.5]
    both = StereoCamera.from_intrinsics(torch.stack([K, K]), torch.tensor([0.5, 0.6]))
    assert both.baseline.tolist() == pytest.approx([0.5, 0.6])
    torch.testing.assert_close(both.T_cam_ref, torch.eye(4).double().expand(2, 4, 4))
    with pytest.raises(InputError, match=r"baseline_m: expected a finite number above 0, got -0\.5"):
        StereoCamera.from_intrinsics(K, -0.5)
    with pytest.raises(InputError, match=r"K: expected \[\[fx, s, cx\]"):
        StereoCamera.from_intrinsics(K.T.contiguous(), 0.5)
    with pytest.raises(InputError, match=r"baseline_m: expected shape \(1,\)"):
        StereoCamera.from_intrinsics(K, torch.tensor([0.5, 0.6]))
    with pytest.raises(InputError, match="K: expected floating point"):
        StereoCamera.from_intrinsics(K.bool(), 0.5)


def test_projections_of_one_frame_and_their_mistakes() -> None:
    """As a camera_info has them: K of the raw images beside P of the rectified ones."""
    K = torch.tensor([[700.0, 0, 300], [0, 700, 90], [0, 0, 1]])
    P_left = torch.cat([K, torch.zeros(3, 1)], dim=1)
    P_right = torch.cat([K, torch.tensor([[-378.0], [0], [0]])], dim=1)
    camera = StereoCamera.from_projections(P_left, P_right)
    assert camera.baseline.tolist() == pytest.approx([0.54])
    assert camera.K_right[0].equal(K)
    with pytest.raises(InputError, match=r"P_left: expected shape \(3, 4\), got \(3, 3\); .* from_intrinsics"):
        StereoCamera.from_projections(K, K)
    for right in (P_left, 2 * P_left - P_right):
        with pytest.raises(InputError, match=r"P_right: expected .*-fx baseline .* camera_info P\[0, 3\] is below 0"):
            StereoCamera.from_projections(P_left, right)
    with pytest.raises(InputError, match=r"P_right: .*swap P_left and P_right"):
        StereoCamera.from_projections(P_right, P_left)
    with pytest.raises(InputError, match=r"K: .*for projections P there is from_projections"):
        StereoCamera.from_intrinsics(P_left, 0.54)
    with pytest.raises(InputError, match=r"baseline_m: .*-P_right\[0, 3\] / P_right\[0, 0\]"):
        StereoCamera.from_intrinsics(K, -0.54)


def same(a: TensorRecord, b: TensorRecord) -> bool:
    pairs = zip(a.tensors(""), b.tensors(""), strict=True)
    return all(
        x.value.dtype == y.value.dtype and torch.allclose(x.value, y.value, rtol=0, atol=0, equal_nan=True)
        for x, y in pairs
    )


MOTION = torch.eye(4)
MOTION[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
GIVEN = {
    "frame_index": torch.tensor([0, 0]),
    "score": torch.tensor([0.5, 0.75]),
    "box_2d": torch.tensor([[10.0, 20.0, 30.0, 40.0], [20.0, 20.0, 50.0, 60.0]]),
    "pose_sigma": torch.full((2, 4), 0.5),
    "track_id": torch.tensor([3, -1]),
    "has_mask_left": torch.tensor([True, False]),
    "T_cam_boxes": MOTION,
}


@pytest.mark.parametrize("name", GIVEN)
@pytest.mark.parametrize(
    "form", [torch.Tensor.tolist, torch.Tensor.numpy, lambda x: np.flip(np.flip(x.numpy()).copy())]
)
def test_what_goes_with_boxes_may_be_arrays_and_lists(name: str, form: Callable[[Tensor], object]) -> None:
    expected = from_boxes(**{name: GIVEN[name].double() if GIVEN[name].is_floating_point() else GIVEN[name]})
    assert same(from_boxes(**{name: form(GIVEN[name])}), expected)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32])
def test_whole_numbers_of_any_width_count_frames(dtype: torch.dtype) -> None:
    assert same(from_boxes(frame_index=torch.zeros(2, dtype=dtype)), from_boxes())
    assert same(from_boxes(frame_index=torch.zeros(2, dtype=dtype).numpy()), from_boxes())


@pytest.mark.parametrize("wrong", [[0.0, 0.5], [True, False], ["0", "0"], [None, None]])
def test_other_things_do_not_count_frames(wrong: object) -> None:
    with pytest.raises(InputError, match=r"^frame_index: expected "):
        from_boxes(frame_index=wrong)


@pytest.mark.parametrize(
    ("form", "dtype"),
    [
        (torch.Tensor.numpy, torch.float64),
        (torch.Tensor.tolist, torch.float64),
        (torch.Tensor.float, torch.float32),
        (torch.Tensor.bfloat16, torch.float32),
        (lambda x: x.half().numpy(), torch.float32),
    ],
)
def test_boxes_of_any_dtype(form: Callable[[Tensor], Any], dtype: torch.dtype) -> None:
    d = STREET.detections
    boxes = poses_to_boxes(d.T_cam_obj, d.dimensions_hwl, "opencv")
    given = form(boxes)
    found = Detections.from_boxes(given, "opencv", mask_left=d.mask_left)
    expected = Detections.from_boxes(
        (given if isinstance(given, Tensor) else torch.from_numpy(np.asarray(given))).to(dtype),
        "opencv",
        mask_left=d.mask_left,
    )
    assert same(found, expected)
    assert found.T_cam_obj.dtype == found.score.dtype == found.box_2d.dtype == dtype


def test_detections_follow_the_frames() -> None:
    frames, detections = STREET.frames.to(torch.float32), disturbed(STREET.detections)
    refiner = DirectShapeRefiner(ellipsoid_prior(torch.float32))
    expected, found = refiner(frames, detections.to(torch.float32)), refiner(frames, detections)
    assert found.T_cam_obj.dtype == torch.float32
    assert found.T_cam_obj.equal(expected.T_cam_obj)


@pytest.mark.parametrize("form", [torch.Tensor.numpy, torch.Tensor.tolist, torch.Tensor.double, torch.Tensor.float])
def test_camera_ground_and_motion_follow_the_images(form: Callable[[Tensor], Any]) -> None:
    K, image, at = torch.tensor([[64.0, 0, 15], [0, 64, 10], [0, 0, 1]]), torch.rand(3, 20, 30), torch.tensor([0.5])
    camera = StereoCamera.from_intrinsics(form(K), form(torch.tensor(0.5)), form(K))
    ground = form(torch.tensor(1.5))
    moved = {"time_s": form(at), "T_world_cam": form(MOTION[None])}
    frames = FrameBatch.from_images(image, image, camera, ground, **moved)
    plain = StereoCamera.from_intrinsics(K, 0.5)
    assert same(frames, FrameBatch.from_images(image, image, plain, 1.5, time_s=at, T_world_cam=MOTION[None]))


@pytest.mark.parametrize("K_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("form", "dtype"),
    [
        (lambda x: x, torch.float32),
        (torch.Tensor.double, torch.float64),
        (torch.Tensor.bfloat16, torch.float32),
        (lambda x: x.double().numpy(), torch.float32),
        (lambda x: (255 * x).byte().numpy(), torch.float32),
    ],
)
def test_images_say_the_dtype(form: Callable[[Tensor], Any], dtype: torch.dtype, K_dtype: torch.dtype) -> None:
    K, image = torch.tensor([[64.0, 0, 15], [0, 64, 10], [0, 0, 1]], dtype=K_dtype), form(torch.rand(3, 20, 30))
    frames = FrameBatch.from_images(image, image, StereoCamera.from_intrinsics(K, 0.5))
    assert {each.value.dtype for each in frames.tensors("") if each.kind != "index"} == {dtype}


def test_images_may_be_bytes() -> None:
    K = STREET.frames.camera.K_left[0].float()
    image = torch.randint(0, 256, (2, 3, 20, 30), dtype=torch.uint8)
    frames = FrameBatch.from_images(image, image, StereoCamera.from_intrinsics(K, 0.5), frame_ids=["a", "b"])
    assert (frames.images_left * 255).round().byte().equal(image)
    assert frames.frame_ids == ("a", "b")
    assert frames.sizes.tolist() == [[20, 30]] * 2
    with pytest.raises(InputError, match=r"images_left: expected shape .*image.permute"):
        FrameBatch.from_images(image.permute(0, 2, 3, 1), image, StereoCamera.from_intrinsics(K, 0.5))


def test_masks_of_some_of_the_cars() -> None:
    left, right = STREET.detections.mask_left.dense(), STREET.detections.mask_right.dense()
    found = from_boxes(mask_left=[None, left[1]], mask_right=[right[0], None])
    assert found.has_mask_left.tolist() == [False, True]
    assert found.has_mask_right.tolist() == [True, False]
    v, u = (left[1] > 0.5).nonzero().unbind(1)
    assert found.box_2d[1].tolist() == [u.min(), v.min(), u.max(), v.max()]
    assert found.box_2d[0].isnan().all()
    mixed = from_boxes(mask_left=[(left[0] > 0.5).byte() * 255, left[1] > 0.5])
    assert (mixed.mask_left.dense() > 0.5).equal(left > 0.5)
    statuses = [status.name for status in DirectShapeRefiner(PRIOR)(STREET.frames, found).status]
    assert statuses[0] == "no_mask"  # a right mask alone does not hold a car
    assert statuses[1] != "no_mask"
    nothing = from_boxes(mask_left=torch.zeros_like(left), mask_right=None)
    assert nothing.box_2d.isnan().all()
    assert {status.name for status in DirectShapeRefiner(PRIOR)(STREET.frames, nothing).status} == {"no_mask"}


def test_masks_are_asked_for_by_name() -> None:
    with pytest.raises(InputError, match="mask_left: expected masks of 2 cars in the left image, got None"):
        from_boxes(mask_left=None, mask_right=None)
    with pytest.raises(InputError, match="mask_left: expected 2 masks, one for each instance, got 1"):
        from_boxes(mask_left=torch.zeros(1, 3, 4, dtype=torch.uint8))
