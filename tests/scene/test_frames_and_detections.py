"""Inputs of a refinement are checked for shapes, and wrong input is named with a cure; statuses have meanings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.synthetic_scene import cached_street
from kornia.geometry import camera as kornia_camera
from kornia.geometry.camera.pinhole import PinholeCamerasList

from directshape_torch.errors import (
    InputError,
)
from directshape_torch.geometry import se3
from directshape_torch.geometry.ground_plane import GroundPlane
from directshape_torch.geometry.projection import project
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.scene.detections import Detections, Occluders
from directshape_torch.status import Status


def test_a_flipped_baseline_is_refused() -> None:
    K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
    T_right_cam = torch.eye(4)[None].clone()
    T_right_cam[0, 0, 3] = 0.54
    with pytest.raises(InputError, match=r"T_right_cam: .* got baseline -0\.5400 m; swap"):
        StereoCamera(K[None], K[None], T_right_cam, torch.zeros(1, 3))


@pytest.mark.parametrize("wrong", [2 * torch.eye(3), torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.zeros(3, 3)])
def test_rotations_are_rotations(wrong: torch.Tensor) -> None:
    scene = cached_street()[1]
    T_right_cam, T_cam_obj = scene.frames.camera.T_right_cam.clone(), scene.detections.T_cam_obj.clone()
    T_right_cam[0, :3, :3], T_cam_obj[1, :3, :3] = wrong, wrong
    with pytest.raises(InputError, match=r"T_right_cam: expected rotations R .* in row 0; leave scale out"):
        replace(scene.frames.camera, T_right_cam=T_right_cam)
    with pytest.raises(InputError, match=r"T_cam_obj: expected rotations R .* in row 1; leave scale out"):
        replace(scene.detections, T_cam_obj=T_cam_obj)
    with pytest.raises(InputError, match=r"other_T_cam_obj\[:, 1\]: expected rotations R .* in row 1; leave scale out"):
        replace(scene.detections, other_T_cam_obj=torch.stack([scene.detections.T_cam_obj, T_cam_obj], dim=1))
    T_cam_obj[0] = torch.nan  # rows without a pose count when the wrong one is named
    with pytest.raises(InputError, match=r"in row 1"):
        replace(scene.detections, T_cam_obj=T_cam_obj)


def test_poses_may_be_rounded_or_unknown() -> None:
    detections = cached_street()[1].detections
    T_cam_obj = detections.T_cam_obj.float().double()
    T_cam_obj[0] = torch.nan
    assert len(replace(detections, T_cam_obj=T_cam_obj)) == 2
    some = replace(detections, other_T_cam_obj=T_cam_obj[:, None])
    assert some.rows(torch.tensor([1])).to(dtype=torch.float32).other_T_cam_obj.equal(T_cam_obj[1:, None].float())


@pytest.mark.parametrize("unknown", [0.5, torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize(
    ("value", "text"),
    [(-0.52, "-0.52; undo the normalisation: images are RGB in"), (1.52, "1.52; divide by 255")],
)
def test_values_outside_of_0_to_1_are_found_beside_any_others(unknown: float, value: float, text: str) -> None:
    frames = cached_street()[1].frames
    spoiled = frames.images_right.clone()
    spoiled[0, 0, 0, :2] = torch.tensor([unknown, value], dtype=spoiled.dtype)
    with pytest.raises(InputError, match=rf"images_right: expected values in \[0, 1\], got a value of {text}"):
        replace(frames, images_right=spoiled)
    spoiled[0, 0, 0, 1] = 1.25 if value > 0 else -0.25
    assert len(replace(frames, images_right=spoiled)) == 1


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"sizes": torch.tensor([[121, 160]])}, "sizes: expected (height, width) within (1..120, 1..160)"),
        ({"sizes": torch.tensor([[0, 160]])}, "sizes: expected"),
        ({"frame_ids": ("a", "b")}, "frame_ids: expected 1 names, got 2"),
        ({"images_right": torch.zeros(1, 3, 120, 161)}, "images_right: expected shape (1, 3, 120, 160)"),
        ({"images_left": torch.zeros(120, 160, 3)}, "images_left: expected shape (F, 3, H, W), got (120, 160, 3)"),
        ({"images_left": torch.zeros(1, 3, 120, 160, dtype=torch.uint8)}, "divide by 255"),
        (
            {"images_right": torch.zeros(1, 3, 120, 160)},
            "images_right: expected the dtype of images_left (torch.float64)",
        ),
        (
            {"images_right": torch.zeros(1, 3, 120, 160, dtype=torch.float64, device="meta")},
            "images_right: expected a tensor with numbers, got one on the device 'meta'; make it on",
        ),
        ({"ground": GroundPlane.from_camera_height(1.6, 2)}, "ground: expected 1 frames, got 2"),
        (
            {"images_right": torch.zeros(1, 3, 120, 160, dtype=torch.uint8)},
            "images_right: expected floating point in [0, 1], got torch.uint8; divide by 255",
        ),
        (
            {"images_left": None},
            "images_left: expected a tensor of shape (F, 3, H, W), got NoneType; stack images",
        ),
        (
            {"images_right": np.zeros((1, 3, 120, 160))},
            "images_right: expected a tensor of shape (1, 3, 120, 160), got ndarray; make one with torch.as_tensor",
        ),
        ({"sizes": [[120, 160]]}, "sizes: expected a tensor of shape (1, 2), got list; make one with torch.as_tensor"),
        ({"sizes": torch.tensor([[120.0, 160.0]])}, "sizes: expected int64 or int32, got torch.float32; convert it"),
    ],
)
def test_wrong_frames_are_named(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError) as error:
        replace(cached_street()[1].frames, **changes)
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("name", "wrong", "text"),
    [
        ("frame_index", torch.zeros(2), "expected int64 or int32, got torch.float32; convert it with .long()"),
        ("frame_index", torch.zeros(2, dtype=torch.uint8), "expected int64 or int32, got torch.uint8"),
        ("frame_index", [0, 0], "expected a tensor of shape (B,), got list; make one with torch.as_tensor"),
        ("T_cam_obj", np.zeros((2, 4, 4)), "expected a tensor of shape (2, 4, 4), got ndarray; make one with"),
        ("score", None, "expected a tensor of shape (2,), got NoneType"),
        ("dimensions_hwl", torch.zeros(3, 3), "expected shape"),
        ("box_2d", torch.zeros(2, 5), "expected shape"),
        ("mask_left", torch.zeros(3, 120, 160), "expected 2 masks, one for each instance, got 3"),
    ],
)
def test_detections_of_the_wrong_type_are_named(name: str, wrong: Any, text: str) -> None:
    with pytest.raises(InputError) as error:
        replace(cached_street()[1].detections, **{name: wrong})
    assert str(error.value).startswith(f"{name}: expected")
    assert text in str(error.value)


def test_ground_planes_point_up_and_are_normalised() -> None:
    up = torch.tensor([[0.0, -1.0, 0.0]])
    with pytest.raises(InputError, match=r"normal: expected a normal pointing up"):
        GroundPlane(-up, torch.ones(1), ("file",))
    with pytest.raises(InputError, match=r"normal: expected unit length"):
        GroundPlane(2 * up, torch.ones(1), ("file",))
    with pytest.raises(InputError, match=r"source: expected 1 entries"):
        GroundPlane(up, torch.ones(1), ())


def test_a_plane_may_lie_above_the_camera_or_be_unknown() -> None:
    """The ground beneath a car on a hill; what is not known fails the cars of its own frame alone."""
    up = torch.tensor([[0.0, -1.0, 0.0]]).repeat(2, 1)
    assert len(GroundPlane(up, torch.tensor([-0.3, torch.nan]), ("file",) * 2).offset) == 2


@pytest.mark.parametrize("height_m", [0.0, -1.65, float("nan"), float("inf")])
def test_camera_heights_are_above_0(height_m: float) -> None:
    with pytest.raises(InputError, match=r"height_m: expected a finite number above 0, got .*; give the camera"):
        GroundPlane.from_camera_height(height_m)


@pytest.mark.parametrize("wrong", [0.0, -1.5, -torch.inf])
def test_dimensions_are_above_0(wrong: float) -> None:
    detections = cached_street()[1].detections
    dimensions_hwl = detections.dimensions_hwl.clone()
    dimensions_hwl[0], dimensions_hwl[1, 2] = torch.nan, wrong
    with pytest.raises(InputError, match=r"dimensions_hwl: expected height, .* in row 1; leave out objects without"):
        replace(detections, dimensions_hwl=dimensions_hwl)
    dimensions_hwl[1, 2] = 4.0
    assert len(replace(detections, dimensions_hwl=dimensions_hwl)) == 2


@pytest.mark.parametrize("side", ["left", "right"])
def test_projections_can_be_inverted(side: str) -> None:
    P = {name: torch.cat([torch.eye(3), torch.tensor([[x], [0.0], [0.0]])], dim=1)[None] for name, x in _SHIFTS}
    assert StereoCamera.from_projections(P["left"], P["right"]).num_frames == 1
    P[side] = P[side].clone()
    P[side][0, 1, 1] = 0.0
    with pytest.raises(
        InputError, match=rf"P_{side}: expected intrinsics K .*, got a singular K; give the projections"
    ):
        StereoCamera.from_projections(P["left"], P["right"])


_SHIFTS = (("left", 0.0), ("right", -0.5))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int64])
def test_projections_have_the_dtype_of_the_left_one(dtype: torch.dtype) -> None:
    P = {name: torch.tensor([[[64, 0, 8, 64 * x], [0, 64, 4, 0], [0, 0, 1, 0]]]) for name, x in _SHIFTS}
    camera = StereoCamera.from_projections(P["left"].to(dtype), P["right"].double())
    assert camera.K_left.dtype == camera.T_right_cam.dtype == (dtype if dtype == torch.float64 else torch.float32)
    torch.testing.assert_close(camera.T_right_cam[0, :3, 3].double(), torch.tensor([-0.5, 0, 0], dtype=torch.float64))


def pinhole(
    T_cam_world: torch.Tensor,  # (F, 4, 4)
    size_hw: tuple[int, int] = (375, 1242),
) -> kornia_camera.PinholeCamera:
    K = torch.diag_embed(T_cam_world.new_tensor([721.5, 719.0, 1.0, 1.0])).repeat(len(T_cam_world), 1, 1)
    K[:, 0, 2], K[:, 1, 2] = 609.6, 172.9
    height, width = (K.new_full((len(K),), side) for side in size_hw)
    return kornia_camera.PinholeCamera(K, T_cam_world, height, width)


def beside(T_cam_world: torch.Tensor, *shift: float) -> torch.Tensor:
    """The left camera moved along its own axes, with its own transform unchanged."""
    T_right_cam = torch.eye(4).to(T_cam_world)
    T_right_cam[:3, 3] = -T_cam_world.new_tensor(shift)
    return T_right_cam @ T_cam_world


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kornias_pinhole_pair(dtype: torch.dtype) -> None:
    """Cameras somewhere in a world, the right one 2.7 mm off vertically: points appear where kornia has them."""
    twist = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [300.0, -2.0, 500.0, 0.3, -1.0, 0.2]], dtype=dtype)
    T_cam_world = se3.exp(twist)
    left, right = pinhole(T_cam_world), pinhole(beside(T_cam_world, 0.54, 0.0027, 0.0))
    rig = StereoCamera.from_kornia(left, right)
    assert rig.K_left.dtype == rig.T_right_cam.dtype == rig.t_cam_ref.dtype == dtype
    assert rig.num_frames == 2
    atol = 1e-4 if dtype == torch.float32 else 1e-12  # a float32 world of 600 m has steps of 0.06 mm
    torch.testing.assert_close(rig.baseline, torch.full((2,), 0.54, dtype=dtype), atol=atol, rtol=0)
    assert not rig.t_cam_ref.any()
    point_cam = torch.tensor([2.0, 1.0, 15.0], dtype=dtype).expand(2, 1, 3)
    point_world = se3.transform(se3.inverse(T_cam_world)[:, None], point_cam)
    expected = right.project(point_world)
    seen = project(se3.transform(rig.T_right_cam[:, None], point_cam), rig.K_right[:, None])
    torch.testing.assert_close(seen, expected, atol=1e3 * atol, rtol=0)

    left.scale_(0.5)  # in place, but of its own matrices
    assert (rig.K_left[:, 0, 0] == rig.K_right[:, 0, 0]).all()


def test_kornias_stereo_camera() -> None:
    P_left = pinhole(torch.eye(4, dtype=torch.float64)[None]).intrinsics[:, :3]
    P_right = P_left.clone()
    P_right[:, 0, 3] = -0.54 * P_left[:, 0, 0]
    theirs = kornia_camera.StereoCamera(P_left, P_right)
    rig = StereoCamera.from_kornia(theirs)
    torch.testing.assert_close(rig.baseline, theirs.tx)
    assert torch.equal(rig.K_right, P_left[..., :3])
    assert not rig.t_cam_ref.any()
    with pytest.raises(InputError, match=r"right: expected None beside kornia's StereoCamera"):
        StereoCamera.from_kornia(theirs, pinhole(torch.eye(4)[None]))


def test_gradients_reach_kornias_cameras() -> None:
    T_left = torch.eye(4, dtype=torch.float64)[None]
    T_right = beside(T_left, 0.54, 0.0, 0.0).requires_grad_()
    StereoCamera.from_kornia(pinhole(T_left), pinhole(T_right)).baseline.sum().backward()
    assert T_right.grad is not None
    assert T_right.grad[0, 0, 3] == -1


def test_kornias_pair_is_checked() -> None:
    T_left = torch.eye(4).repeat(2, 1, 1)
    T_right = beside(T_left, 0.54, 0.0, 0.0)
    left, right = pinhole(T_left), pinhole(T_right)
    turned = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 1e-3, 0.0])) @ T_right
    for wrong, message in (
        (None, r"right: expected kornia's PinholeCamera beside the left one, got NoneType; for matrices"),
        (pinhole(T_right[:1]), r"right: expected the frames of the left camera: 2, got 1; give both cameras"),
        (pinhole(T_right, (370, 1242)), r"the \(height, width\) of the left .*375.* got .*370.*; give both"),
        (pinhole(T_right.double()), r"the dtype of the left camera: torch.float32, got torch.float64; give both"),
        (pinhole(turned), r"right: expected a rectified pair: .* got a turn by 0\.001 .* in row 0; rectify the images"),
        (pinhole(beside(T_left, 0.54, 0.1, 0.0)), r"a rectified pair: .* \[-0\.54, -0\.1, 0\.0\] m in row 0; rectify"),
        (pinhole(beside(T_left, -0.54, 0.0, 0.0)), r"T_right_cam: .* got baseline -0\.5400 m; swap the two cameras"),
        (pinhole(2 * T_left), r"right: expected rotations R with .* leave scale out"),
        (pinhole(T_left + torch.nan), r"T_right_cam: expected finite numbers, got NaN or infinity"),
    ):
        with pytest.raises(InputError, match=message):
            StereoCamera.from_kornia(left, wrong)
    for wrong, message in (
        (T_left, r"left: expected kornia's PinholeCamera or StereoCamera, got Tensor; for matrices there is"),
        (PinholeCamerasList([left]), r"left.intrinsics: expected shape \(F, 4, 4\), got \(2, 1, 4, 4\); give one"),
        (pinhole(T_left.half()), r"left: expected float32 or float64, got torch.float16; convert"),
    ):
        with pytest.raises(InputError, match=message):
            StereoCamera.from_kornia(wrong, right)  # type: ignore[arg-type]


def test_moving_to_a_dtype_keeps_integers_and_masks() -> None:
    scene = cached_street()[1]
    frames, detections = scene.frames.to(torch.float32), scene.detections.to(dtype=torch.float32)
    assert frames.images_left.dtype == frames.camera.K_left.dtype == frames.ground.normal.dtype == torch.float32
    assert frames.sizes.dtype == detections.frame_index.dtype == torch.int64
    assert detections.has_mask_left.dtype == torch.bool
    assert frames.frame_ids == scene.frames.frame_ids


def test_masks_keep_their_dtype_where_numbers_follow_the_frames() -> None:
    detections = cached_street()[1].detections
    soft = replace(detections, mask_left=0.9 * detections.mask_left.dense().half())
    for dtype in (torch.float32, torch.float64):
        moved = soft.in_dtype(dtype)
        assert (moved.T_cam_obj.dtype, moved.mask_left.values.dtype) == (dtype, torch.float16)
        assert moved.mask_left.dense().equal(soft.mask_left.dense())


def test_cars_with_masks_and_then_of_higher_scores_tell_most() -> None:
    count = 300
    score = torch.linspace(0, 1, count)
    masks = torch.zeros(count, 4, 6)
    masks[:50:2] = 1.0
    boxes = torch.tensor([[0.0, 1.6, 20.0, 1.5, 1.6, 4.0, 0.0]]).repeat(count, 1)
    frame_index = torch.arange(count) // 150
    detections = Detections.from_boxes(boxes, mask_left=masks, score=score, frame_index=frame_index)
    assert detections.telling_rows(0) == [*range(0, 50, 2), *range(75, 150)]
    assert detections.telling_rows(1) == list(range(200, 300))
    assert detections.rows(torch.arange(20)).telling_rows(0) == list(range(20))


def test_whoever_hides_cars_hides_whichever_are_chosen() -> None:
    masks = torch.zeros(3, 120, 160)
    occluders = Occluders(torch.zeros(3).long(), masks, masks, torch.ones(3), torch.ones(3))
    detections = replace(cached_street()[1].detections.to(torch.float32), occluders=occluders)
    second = detections.rows(torch.tensor([1]))
    assert second.T_cam_obj.equal(detections.T_cam_obj[1:])
    assert second.occluders is not None
    assert len(second.occluders.depth_m) == 3


def test_status_codes_are_stable_and_messages_advise() -> None:
    names = [Status.from_code(code).name for code in range(8)]
    assert names == [
        "converged", "max_iterations", "no_mask", "too_few_pixels",
        "behind_camera", "singular", "non_finite", "rejected_worse",
    ]  # fmt: skip
    assert [s.name for s in Status if s.is_refined] == ["converged", "max_iterations", "rescued"]
    assert all(Status.from_code(s.code) is s for s in Status)
    assert len({s.value for s in Status}) == len(Status)
