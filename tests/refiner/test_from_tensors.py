"""A detector's tensors are refined and returned without files or conversions by the user."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import cached_street, disturbed
from safetensors.torch import load, save
from torch import Tensor

from directshape_torch import (
    Detections,
    DirectShapeRefiner,
    FrameBatch,
    InputError,
    MissingDependencyError,
    RefinementResult,
    RigEstimate,
    StereoCamera,
)
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.numerics.records import TensorRecord
from directshape_torch.status import Status

PRIOR, STREET = cached_street()


@lru_cache(maxsize=1)
def refined() -> RefinementResult:
    return DirectShapeRefiner(PRIOR)(STREET.frames, disturbed(STREET.detections))


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


def test_a_refiner_and_a_result_in_half_precision_are_refused() -> None:
    with pytest.raises(InputError, match=r"^refiner: expected shapes in float32 or float64, got torch.bfloat16"):
        DirectShapeRefiner(ellipsoid_prior()).bfloat16()(STREET.frames, STREET.detections)
    with pytest.raises(
        InputError, match=r"^dtype: expected float32 or float64, got torch.float16; convert what to_boxes"
    ):
        refined().to(torch.float16)
    with pytest.raises(
        InputError, match=r"^code: expected the dtype of the prior \(torch.float64\), got torch.float32"
    ):
        PRIOR.values(torch.zeros(1, 3))


def test_images_may_be_bytes() -> None:
    K = STREET.frames.camera.K_left[0].float()
    image = torch.randint(0, 256, (2, 3, 20, 30), dtype=torch.uint8)
    frames = FrameBatch.from_images(image, image, StereoCamera.from_intrinsics(K, 0.5), frame_ids=["a", "b"])
    assert (frames.images_left * 255).round().byte().equal(image)
    assert frames.frame_ids == ("a", "b")
    assert frames.sizes.tolist() == [[20, 30]] * 2
    with pytest.raises(InputError, match=r"images_left: expected shape .*image.permute"):
        FrameBatch.from_images(image.permute(0, 2, 3, 1), image, StereoCamera.from_intrinsics(K, 0.5))


@pytest.mark.parametrize("kind", [torch.bool, torch.uint8, torch.float32, torch.float64, np.bool_, np.float64])
def test_masks_of_any_kind(kind: Any) -> None:
    left = STREET.detections.mask_left.dense() > 0.5
    masks = left.to(kind) if isinstance(kind, torch.dtype) else left.numpy().astype(kind)
    found = from_boxes(mask_left=masks, mask_right=None)
    assert (found.mask_left.dense() > 0.5).equal(left)
    assert not found.has_mask_right.any()
    assert found.has_mask_left.all()
    grey = from_boxes(mask_left=left.byte() * 255)
    assert (grey.mask_left.dense() > 0.5).equal(left)


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
    with pytest.raises(
        InputError, match=r"mask_left: expected masks of one size.*; where no car has a mask give MaskC"
    ):
        from_boxes(mask_left=[None, None])
    with pytest.raises(InputError, match=r"mask_left: expected masks of one size .*\(3, 4\), \(3, 5\)"):
        from_boxes(mask_left=[torch.zeros(3, 4), torch.zeros(3, 5)])
    with pytest.raises(InputError, match="mask_left: expected bool"):
        from_boxes(mask_left=STREET.detections.mask_left.dense().long())
    with pytest.raises(InputError, match="mask_left: expected 2 masks, one for each instance, got 1"):
        from_boxes(mask_left=torch.zeros(1, 3, 4, dtype=torch.uint8))


def test_results_are_indexed_like_tensors() -> None:
    result = refined()
    assert len(result) == 2
    turned, nothing = (slice(None, None, -1), [1, 0]), (slice(0, 0), [])
    for index, rows in ((1, [1]), (-1, [1]), (slice(None), [0, 1]), turned, nothing, ([1, 0], [1, 0])):
        part = result[index]
        torch.testing.assert_close(part.T_cam_obj, result.T_cam_obj[rows])
        torch.testing.assert_close(part.quality.mask_iou_left, result.quality.mask_iou_left[rows])
        assert part.profile.offsets_px.equal(result.profile.offsets_px)
        assert len(part.ground_source) == len(part.status) == len(rows)
        assert part.term_names == result.term_names
    good = torch.tensor([False, True])
    assert result[good].code.equal(result.code[1:])
    assert result[good.numpy()].code.equal(result.code[1:])
    assert [one.status[0] for one in result] == result.status
    for wrong in (2, -3, [2], good[:1], torch.tensor([0.5])):
        with pytest.raises(InputError, match="index: expected"):
            result[wrong]


def test_boxes_in_conventions_and_frames() -> None:
    result, boxes = refined(), refined().boxes()
    kitti = result.to_boxes("kitti", frame="ref")
    torch.testing.assert_close(kitti[:, :3], boxes.location_ref)
    torch.testing.assert_close(kitti[:, 3:6], boxes.dimensions_hwl)
    torch.testing.assert_close(kitti[:, 6], boxes.rotation_y)
    in_cam = result.to_boxes("kitti")
    torch.testing.assert_close(in_cam[:, :3] - kitti[:, :3], result.t_cam_ref)
    # A car that was refined has its axes within a tilt of upright: the corners enclose its middle.
    corners = result.corners()
    torch.testing.assert_close(corners.mean(dim=1), result.to_boxes("opencv")[:, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(corners - result.corners("ref"), result.t_cam_ref[:, None].expand(-1, 8, -1))
    again = Detections.from_boxes(result.to_boxes("mmdet3d_camera"), "mmdet3d_camera", mask_left=torch.ones(2, 9, 9))
    torch.testing.assert_close(again.dimensions_hwl, boxes.dimensions_hwl)
    from_corners = Detections.from_boxes(corners, "kitti", mask_left=torch.ones(2, 9, 9))
    torch.testing.assert_close(from_corners.T_cam_obj[:, :3, :3], result.T_cam_obj[:, :3, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(from_corners.dimensions_hwl, boxes.dimensions_hwl)
    with pytest.raises(InputError, match="T_cam_boxes: expected the rigid motion"):
        result.to_boxes("nuscenes")
    with pytest.raises(InputError, match="frame: expected 'cam' or 'ref', got 'world'"):
        result.to_boxes("kitti", frame="world")  # type: ignore[arg-type]


def test_results_move_and_give_arrays() -> None:
    result = refined()
    single = result.to(dtype=torch.float32)
    assert single.T_cam_obj.dtype == single.boxes().location_ref.dtype == torch.float32
    assert single.covariance.dtype == single.quality.mask_iou_left.dtype == torch.float64
    assert single.prior.origin.dtype == torch.float32
    assert result.prior.origin.dtype == torch.float64  # the refiner's own shapes stay
    assert result.cpu().prior is result.prior
    assert result.to(torch.float32).code.dtype == result.to("cpu", torch.float32).code.dtype == torch.float32
    attached = replace(result, T_cam_obj=result.T_cam_obj.clone().requires_grad_())
    assert not attached.detach().T_cam_obj.requires_grad
    arrays = attached.numpy()
    assert arrays["status"].tolist() == [status.name for status in result.status]
    assert arrays["boxes.rotation_y"].shape == (2,)
    assert arrays["term_names"].tolist() == list(result.term_names)
    np.testing.assert_array_equal(arrays["T_cam_obj"], result.T_cam_obj.numpy())


def test_results_are_stored_without_pickles() -> None:
    result = refined()
    state = result.state_dict()
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    for read in (torch.load(buffer, weights_only=True), load(save(state))):
        again = RefinementResult.from_state_dict(read, PRIOR)
        assert again.state_dict().keys() == state.keys()
        assert all(again.state_dict()[name].equal(value) or value.isnan().any() for name, value in state.items())
        assert again.status == result.status
        assert (again.term_names, again.ground_source) == (result.term_names, result.ground_source)
        torch.testing.assert_close(again.boxes().location_ref, result.boxes().location_ref)
    assert RefinementResult.from_state_dict(result[:0].state_dict(), PRIOR).ground_source == ()
    with pytest.raises(InputError, match=r"state: expected the tensor 'quality\.evidence'"):
        RefinementResult.from_state_dict({k: v for k, v in state.items() if k != "quality.evidence"}, PRIOR)
    with pytest.raises(InputError, match=r"prior: expected the prior of the result, with \d codes"):
        RefinementResult.from_state_dict(replace(result, code=result.code[:, :1]).state_dict(), PRIOR)
    covariance = torch.eye(4, dtype=torch.float64).expand(len(result), 4, 4).clone()
    covariance[1, 0, 0] = -1.0  # of nothing
    for wrong in ({"code": 0 * result.code + 1e9}, {"covariance_xyz_yaw": covariance}):
        with pytest.raises(InputError, match=r"state: expected finite boxes .*, got none of cars \[.*1"):
            RefinementResult.from_state_dict(state | wrong, PRIOR)


def test_state_of_the_module_is_stored_without_pickles() -> None:
    """With what is known of the rig, which is extra state beside the tensors of the shapes."""
    rig = RigEstimate.of_frames(STREET.frames)
    rig.update(STREET.frames, STREET.detections)
    refiner, other = (DirectShapeRefiner(PRIOR, rig=each) for each in (rig, RigEstimate.of_frames(STREET.frames)))
    buffer = io.BytesIO()
    torch.save(refiner.state_dict(), buffer)
    buffer.seek(0)
    other.load_state_dict(torch.load(buffer, weights_only=True))
    torch.testing.assert_close(other.rig.mean, rig.mean)
    plain = DirectShapeRefiner(PRIOR)
    DirectShapeRefiner(PRIOR).load_state_dict(load(save(plain.state_dict())))


def test_meshes_of_all_cars(monkeypatch: pytest.MonkeyPatch) -> None:
    result = refined()
    surfaces = result.meshes()
    assert [mesh.is_watertight for mesh in surfaces] == [True, True]
    monkeypatch.setitem(sys.modules, "pytorch3d", None)
    with pytest.raises(MissingDependencyError, match="needs the package 'pytorch3d'"):
        result.meshes("pytorch3d")
    structures = ModuleType("pytorch3d.structures")
    structures.Meshes = lambda verts, faces: SimpleNamespace(verts=verts, faces=faces)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pytorch3d", ModuleType("pytorch3d"))
    monkeypatch.setitem(sys.modules, "pytorch3d.structures", structures)
    batch = result.meshes("pytorch3d")
    assert [len(vertices) for vertices in batch.verts] == [len(mesh.vertices) for mesh in surfaces]
    assert batch.verts[0].dtype == torch.float64
    assert batch.faces[0].dtype == torch.int64
    with pytest.raises(InputError, match="kind: expected 'trimesh' or 'pytorch3d'"):
        result.meshes("blender")  # type: ignore[arg-type]


def test_a_result_prints_all_of_its_cars() -> None:
    result = refined()
    lines = repr(result[[0, 1] * 8]).splitlines()
    assert lines[0] == "RefinementResult of 16 cars (torch.float64, cpu)"
    assert lines[1] == "  16 refined (converged 8, max_iterations 8)"
    assert [int(line.split()[0]) for line in lines[3:]] == list(range(16))
    assert repr(result[:0]).splitlines()[1:] == ["  no cars"]


def test_a_result_prints_whose_front_is_unknown() -> None:
    result = refined()[[0, 1]]
    assert "?" not in repr(result)
    result.quality.probability_heading[1] = 0.5
    *_, first, second, legend = repr(result).splitlines()
    assert "?" not in first
    assert f"{float(result.to_boxes('kitti')[1, 6]):.2f}?" in second
    assert legend == "  ? either end may be the front (quality.probability_heading)"


def test_a_result_of_many_cars_prints_those_that_need_a_look() -> None:
    """Car 90 has no mask, car 70 is doubtful; the first 38 of the others fill the table."""
    result = refined()[[0, 1] * 50]
    result.status_code[90] = Status.no_mask.code
    result.quality.probability_better[:] = 0.9
    result.quality.probability_better[70] = 0.4
    lines = repr(result).splitlines()
    assert lines[1] == "  99 refined (converged 50, max_iterations 49), 1 as before (no_mask 1)"
    assert lines[2] == f"  no_mask: {Status.no_mask.value}"
    assert [int(line.split()[0]) for line in lines[4:-1]] == [*range(38), 70, 90]
    assert lines[-1].startswith("  60 more cars are not shown, all refined, none doubtful (better below 0.5)")
    result.quality.probability_better[:] = 0.4
    assert "60 more cars are not shown, 60 of them not refined or doubtful" in repr(result).splitlines()[-1]
    result.quality.probability_better[:] = float("nan")
    assert "all refined, none doubtful" in repr(result).splitlines()[-1]
