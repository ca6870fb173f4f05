"""A car that cannot be refined says why, gets its input back to the bit, and does not affect other cars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import (
    cached_street,
    disturbed,
    joined_detections,
    joined_frames,
    masked,
    select,
    street,
)
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import ConfigError, InputError
from directshape_torch.geometry import se3
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.status import Status


def refine(frames: FrameBatch, detections: Detections, config: RefinerConfig = DEFAULT) -> RefinementResult:
    return DirectShapeRefiner(cached_street()[0], config)(frames, detections)


def base() -> tuple[FrameBatch, Detections]:
    scene = cached_street()[1]
    return scene.frames, disturbed(scene.detections)


@lru_cache(maxsize=1)
def healthy() -> RefinementResult:
    return refine(*base())


def with_third(change: Callable[[Detections], Detections]) -> tuple[FrameBatch, Detections]:
    """The two cars and a third row, made from the second by `change`, whose mask is empty unless `change` sets one."""
    frames, detections = base()
    third = select(detections, torch.tensor([1]))
    third = change(replace(third, mask_left=0 * third.mask_left.dense(), mask_right=0 * third.mask_right.dense()))
    return frames, Detections.joined([detections, third])


def assert_others_unchanged(result: RefinementResult) -> None:
    """Assert equality to the bit if the bad car never reached the solver, else to rounding as it left the batch."""
    expected = healthy()
    tolerance = 0.0 if result.cost_before[2].isnan().all() else 1e-11
    for name in ("T_cam_obj", "code", "status_code", "iterations", "cost_before", "cost_after"):
        mine, theirs = getattr(result, name)[:2], getattr(expected, name)
        torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=tolerance, msg=name)
    torch.testing.assert_close(result.covariance[:2], expected.covariance, rtol=1e-8, atol=1e-14)


def _posed(T_cam_obj: Tensor) -> Callable[[Detections], Detections]:
    return lambda d: replace(d, T_cam_obj=T_cam_obj.to(d.T_cam_obj)[None])


def _pose(twist: list[float]) -> Tensor:
    return se3.exp(torch.tensor(twist, dtype=torch.float64))


def _five_pixels(d: Detections) -> Detections:
    mask = torch.zeros_like(d.mask_left.dense())
    mask[0, 100, 10:15] = 1
    box = torch.tensor([[10.0, 100.0, 14.0, 100.0]], dtype=d.box_2d.dtype)
    far = _pose([-30.0, 30.0, 100.0, 0, 0, 0])[None]
    return replace(d, mask_left=mask, mask_right=mask, box_2d=box, T_cam_obj=far)


def _masked(d: Detections) -> Detections:
    """A mask at the lower edge of the left image, away from the other cars."""
    mask = torch.zeros_like(d.mask_left.dense())
    mask[0, 105:118, 40:80] = 1
    return replace(d, mask_left=mask)


def _no_mask(d: Detections) -> Detections:
    absent = torch.zeros_like(d.has_mask_left)
    return masked(d, absent, absent)


def _outside(d: Detections) -> Detections:
    box = torch.tensor([[-90.0, 40.0, -20.0, 80.0]], dtype=d.box_2d.dtype)
    return replace(_no_mask(d), box_2d=box, T_cam_obj=_pose([-40.0, 1.6, 10.0, 0, 0, 0])[None])


CASES: dict[str, tuple[Callable[[Detections], Detections], set[Status]]] = {
    "behind the camera": (_posed(_pose([0.0, 1.6, -10.0, 0, 0, 0])), {Status.behind_camera}),
    "at the camera": (_posed(_pose([0.0, 1.6, 0.2, 0, 0, 0])), {Status.behind_camera}),
    "upside down": (_posed(_pose([0.0, 1.6, 20.0, 3.14159, 0, 0])), {Status.behind_camera}),
    "nan pose": (_posed(torch.full((4, 4), torch.nan)), {Status.non_finite}),
    "infinite pose": (_posed(torch.full((4, 4), torch.inf)), {Status.non_finite}),
    "no mask": (_no_mask, {Status.no_mask}),
    "outside the image": (_outside, {Status.no_mask}),
    "five pixels": (_five_pixels, {Status.too_few_pixels}),
    "all-zero mask": (lambda d: d, {Status.no_mask}),
    "nan box": (lambda d: replace(_no_mask(d), box_2d=d.box_2d * torch.nan), {Status.no_mask}),
    "nan mask": (lambda d: replace(d, mask_left=d.mask_left.dense() * torch.nan), {Status.non_finite}),
    "nan dimensions": (lambda d: replace(_masked(d), dimensions_hwl=d.dimensions_hwl * torch.nan), {Status.non_finite}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_bad_car_beside_good_ones(case: str) -> None:
    change, allowed = CASES[case]
    frames, detections = with_third(change)
    result = refine(frames, detections)
    assert result.status[2] in allowed
    assert_others_unchanged(result)
    if not result.status[2].is_refined:
        torch.testing.assert_close(result.T_cam_obj[2], detections.T_cam_obj[2], rtol=0, atol=0, equal_nan=True)
        assert (result.code[2] == 0).all()
    assert len(result.status[2].value) > 20


def test_a_car_without_a_pose_hides_no_other_by_its_depth() -> None:
    """Its depth is unknown, so its mask hides only cars whose boxes end higher up in the image: none here."""

    def phantom(d: Detections) -> Detections:
        mask = cached_street()[1].detections.mask_left.dense()[1:2]
        box = d.box_2d - torch.tensor([0.0, 20.0, 0.0, 20.0], dtype=d.box_2d.dtype)
        return replace(d, mask_left=mask, box_2d=box, T_cam_obj=d.T_cam_obj * torch.nan)

    result = refine(*with_third(phantom))
    assert result.status[2] is Status.non_finite
    assert_others_unchanged(result)


def test_a_left_mask_is_enough_and_a_right_one_alone_is_not() -> None:
    frames, detections = base()
    nobody = torch.zeros(2, dtype=torch.bool)
    result = refine(frames, masked(detections, right=nobody))
    assert all(status.is_refined for status in result.status)
    assert result.T_cam_obj.isfinite().all()
    assert (result.cost_after.sum(1) < result.cost_before.sum(1)).all()
    result = refine(frames, masked(detections, left=nobody))
    assert result.status == [Status.no_mask] * 2
    assert torch.equal(result.T_cam_obj, detections.T_cam_obj)


@pytest.mark.parametrize("side", ["images_left", "images_right"])
def test_a_nan_image_fails_its_own_frame_only(side: str) -> None:
    first = cached_street()[1]
    second = street(ellipsoid_prior(), [(0.5, 1.65, 9.0)], [0.8])
    detections = joined_detections([disturbed(first.detections), disturbed(second.detections)], (120, 160))
    frames = joined_frames([first.frames, second.frames])
    expected = refine(frames, detections)
    image = getattr(frames, side).clone()
    image[1] = torch.nan
    result = refine(replace(frames, **{side: image}), detections)
    assert result.status[2] is Status.non_finite
    assert torch.equal(result.T_cam_obj[2], detections.T_cam_obj[2])
    assert result.status[:2] == expected.status[:2]
    torch.testing.assert_close(result.T_cam_obj[:2], expected.T_cam_obj[:2], rtol=0, atol=1e-11)
    torch.testing.assert_close(result.code[:2], expected.code[:2], rtol=0, atol=1e-10)
    torch.testing.assert_close(result.profile.cost_after[:2], expected.profile.cost_after[:2], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("what", ["K_left", "K_right", "T_right_cam", "t_cam_ref"])
def test_a_nan_calibration_is_named(what: str) -> None:
    camera = cached_street()[1].frames.camera
    broken = getattr(camera, what).clone()
    broken[0, 0] = torch.nan
    with pytest.raises(InputError, match=f"{what}: expected finite numbers"):
        replace(camera, **{what: broken})


def test_a_nan_ground_plane_fails_its_own_frame_only() -> None:
    first = cached_street()[1]
    frames = joined_frames([first.frames, first.frames])
    offset = frames.ground.offset.clone()
    offset[1] = torch.nan
    result = refine(
        replace(frames, ground=replace(frames.ground, offset=offset)),
        joined_detections([disturbed(first.detections)] * 2, (120, 160)),
    )
    assert result.status[2:] == [Status.non_finite] * 2
    torch.testing.assert_close(result.T_cam_obj[:2], healthy().T_cam_obj, rtol=0, atol=1e-10)


def test_arguments_of_the_wrong_kind_are_named() -> None:
    frames, detections = base()
    refiner = DirectShapeRefiner(cached_street()[0], DEFAULT)
    cure = r"; call it as refiner\(frames, detections\)"
    with pytest.raises(InputError, match=r"^frames: expected a FrameBatch, got Detections" + cure):
        refiner(detections, frames)
    with pytest.raises(InputError, match=r"^detections: expected a Detections, got dict" + cure):
        refiner(frames, {})
    with pytest.raises(InputError, match=r"^frames: expected a FrameBatch, got NoneType" + cure):
        refiner.problem(None, detections)  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(dtype: torch.dtype) -> None:
    frames, detections = base()
    with pytest.raises(InputError, match=rf"frames: expected float32 or float64, got {dtype}; refine outside of half"):
        refine(frames.to(dtype=dtype), detections)


@pytest.mark.parametrize(
    ("config", "cure"),
    [
        ("fast", r'got \'fast\'; pass config=load_config\("fast"\)$'),
        ("mine.yaml", r'pass config=load_config\("mine.yaml"\)$'),
        (
            {"compile": "off"},
            r'got \{\'compile\': \'off\'\}; pass config=load_config\("fast"\), or config_from_mapping',
        ),
    ],
)
def test_settings_that_are_none_name_the_cure(config: object, cure: str) -> None:
    with pytest.raises(InputError, match=r"config: expected a RefinerConfig, .*" + cure):
        DirectShapeRefiner(config=config)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"prior: expected a ShapePrior, got RefinerConfig; pass it as config="):
        DirectShapeRefiner(DEFAULT)  # type: ignore[arg-type]


def test_weights_that_are_all_zero_are_named() -> None:
    priors = replace(DEFAULT.priors, shape_weight=0.0, height_weight=0.0, tilt_weight=0.0, dimensions_weight=0.0)
    config = replace(
        DEFAULT,
        silhouette=replace(DEFAULT.silhouette, weight=0.0),
        photometric=replace(DEFAULT.photometric, weight=0.0),
        priors=priors,
    )
    with pytest.raises(ConfigError, match=r"^expected a term of weight above 0, got none: silhouette"):
        refine(*base(), config)


@pytest.mark.parametrize("index", [2, 99, -3])
def test_a_car_that_does_not_exist_has_no_mesh(index: int) -> None:
    with pytest.raises(InputError, match=rf"index: expected a car of 0\.\.1, got {index}: 2 cars"):
        healthy().mesh(index)


def test_what_the_caller_writes_into_his_dimensions_is_not_in_the_result() -> None:
    frames, detections = base()
    detections = replace(detections, dimensions_hwl=detections.dimensions_hwl.clone())
    result = refine(frames, detections)
    before = result.input_dimensions_hwl.clone()
    detections.dimensions_hwl.zero_()
    assert torch.equal(result.input_dimensions_hwl, before)


@pytest.mark.parametrize("frames_too", [False, True])
def test_no_cars(frames_too: bool) -> None:
    frames, detections = base()
    if frames_too:
        frames = replace(
            frames,
            images_left=frames.images_left[:0],
            images_right=frames.images_right[:0],
            sizes=frames.sizes[:0],
            camera=type(frames.camera)(
                *(getattr(frames.camera, n)[:0] for n in ("K_left", "K_right", "T_right_cam", "t_cam_ref"))
            ),
            ground=type(frames.ground)(frames.ground.normal[:0], frames.ground.offset[:0], ()),
            frame_ids=(),
        )
    result = refine(frames, select(detections, torch.zeros(0, dtype=torch.long)))
    assert len(result) == 0
    assert result.status == []
    assert result.boxes().dimensions_hwl.shape == (0, 3)
    assert result.covariance.shape == (0, 9, 9)
    assert result.profile.after.offset_px.shape == (0,)


def test_a_car_that_is_not_refined_keeps_the_detectors_box_and_has_no_figures() -> None:
    frames, detections = with_third(_no_mask)
    detections = replace(detections, dimensions_hwl=torch.tensor([[2.2, 2.0, 5.2]]).double().repeat(3, 1))
    result = refine(frames, detections)
    assert result.status[2] is Status.no_mask
    boxes = result.boxes()
    assert torch.equal(boxes.dimensions_hwl[2], detections.dimensions_hwl[2])
    torch.testing.assert_close(boxes.location_ref[2], result.T_ref_obj[2, :3, 3])
    assert result.covariance[2].isnan().all()
    assert result.covariance_xyz_yaw[2].isnan().all()
    assert result.quality.mask_iou_left[2].isnan()
    assert result.quality.mask_iou_left[:2].isfinite().all()


def test_nearer_cars_hide_right_pixels_even_of_cars_without_a_right_mask_and_when_not_refined_themselves() -> None:
    """What hides a car in the right image is known from all detections, wherever the warp may land."""
    frames, detections = base()
    everything = torch.ones_like(detections.mask_right.dense()[:1])
    at_camera = detections.T_cam_obj[:1].clone()
    at_camera[:, 2, 3] = 0.9
    wall = replace(
        select(detections, torch.tensor([0])),
        T_cam_obj=at_camera,
        mask_left=torch.zeros_like(everything),
        mask_right=everything,
    )
    far = masked(select(detections, torch.tensor([1])), right=torch.tensor([False]))
    both = Detections.joined([far, wall])
    result = refine(frames, both)
    assert result.status[1] is Status.behind_camera
    # Every right pixel is behind the wall, so nothing can be compared photometrically.
    assert not (result.quality.matched_share[0] > 0)
