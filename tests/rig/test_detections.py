"""Detections of a rendered frame show no offset, or the offset by which its right image is warped."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.bundled_frame import with_true_boxes
from helpers.quick_runs import EVERY_RESULT, IMAGES_ALONE
from helpers.synthetic_scene import masked
from torch import Tensor

import directshape_torch
from directshape_torch import DirectShapeRefiner, RigEstimate, check_scene
from directshape_torch.errors import InputError
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.rig.detections import observe_detections, size_error
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.stereo_matching.disparity import with_disparity

DISPARITY, OFFSET, ROW_OFFSET = 2, 3, 5
POINTS_ALONE = (
    "silhouette.weight=0",
    "photometric.weight=0",
    "point_cloud.weight=300",
    "priors.detector_weight=0",
)


@pytest.fixture(scope="module")
def demo() -> LoadedFrame:
    """The six cars with their true boxes."""
    return with_true_boxes()


@pytest.fixture(scope="module")
def exact(demo: LoadedFrame) -> Tensor:
    """What the true boxes show of the frame as it is."""
    rows: Tensor = observe_detections(demo.frame, demo.detections)
    return rows


def warped(frames: FrameBatch, disparity_px: float, rows_px: float) -> FrameBatch:
    """The frame with the right image moved to the left and down by given amounts."""
    height, width = frames.images_right.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    uv = torch.stack([u + disparity_px, v - rows_px], dim=-1)
    grid = 2 * uv / torch.tensor([width - 1, height - 1]) - 1
    right = torch.nn.functional.grid_sample(
        frames.images_right, grid[None], mode="bicubic", align_corners=True, padding_mode="border"
    )
    return replace(frames, images_right=right.clamp(0, 1))


def closer(detections: Detections, share: float) -> Detections:
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[:, :3, 3] *= 1 - share
    return replace(detections, T_cam_obj=T_cam_obj)


def difference(rows: Tensor, column: int, before: Tensor) -> float:
    return float((rows[:, column].median() - before[:, column].median()).abs())


def test_true_boxes_see_what_the_right_image_is_warped_by(demo: LoadedFrame, exact: Tensor) -> None:
    assert len(exact) >= 4
    assert float(exact[:, OFFSET].median().abs()) < 0.25
    seen = observe_detections(warped(demo.frame, 0.8, 0.3), demo.detections)
    assert difference(seen, OFFSET, exact) == pytest.approx(0.8, abs=0.1)
    assert difference(seen, ROW_OFFSET, exact) == pytest.approx(0.3, abs=0.1)


def with_other_principal_point(frames: FrameBatch, by_px: float) -> FrameBatch:
    """The frame with the right image cropped at the left by a given amount, and with matching intrinsics."""
    K_right = frames.camera.K_right.clone()
    K_right[:, 0, 2] -= by_px
    return replace(warped(frames, by_px, 0.0), camera=replace(frames.camera, K_right=K_right))


def test_principal_points_that_differ_change_no_observation(demo: LoadedFrame, exact: Tensor) -> None:
    moved = observe_detections(with_other_principal_point(demo.frame, 40.0), demo.detections)
    for column in (DISPARITY, OFFSET):
        assert difference(moved, column, exact) < 0.1
    swapped = check_scene(with_other_principal_point(demo.frame, -60.0), demo.detections, match_images=False)
    assert "images_swapped" not in str(swapped)


def test_boxes_that_are_far_off_or_not_there_say_nothing(demo: LoadedFrame) -> None:
    assert len(observe_detections(demo.frame, closer(demo.detections, 0.6))) == 0
    nothing = replace(demo.detections, T_cam_obj=torch.full_like(demo.detections.T_cam_obj, torch.nan))
    assert len(observe_detections(demo.frame, nothing)) == 0
    blank = replace(demo.frame, images_right=torch.full_like(demo.frame.images_right, 0.5))
    assert len(observe_detections(blank, demo.detections)) == 0


@pytest.mark.parametrize("row", [0, 1])  # height and width, which lies along the ray
def test_a_box_beyond_all_numbers_has_no_size_in_the_image(row: int) -> None:
    K, T_cam_obj = torch.tensor([[700.0, 0, 100], [0, 700, 50], [0, 0, 1]]), torch.eye(4)
    T_cam_obj[:3, 3] = torch.tensor([0.0, 1.6, 30.0])
    mask = torch.zeros(120, 200, dtype=torch.bool)
    mask[51:88, 60:140] = True
    dimensions_hwl = torch.tensor([1.5, 1.6, 4.0])
    assert size_error(T_cam_obj, dimensions_hwl, mask, K) > 0
    dimensions_hwl[row] = 1e30
    assert size_error(T_cam_obj, dimensions_hwl, mask, K) == 0


def test_padding_of_a_batch_changes_no_observation(demo: LoadedFrame, exact: Tensor) -> None:
    height, width = demo.frame.images_left.shape[-2:]
    pad = {
        name: torch.nn.functional.pad(getattr(demo.frame, name), (0, 31, 0, 17))
        for name in ("images_left", "images_right")
    }
    masks = {
        name: getattr(demo.detections, name).padded((height + 17, width + 31)) for name in ("mask_left", "mask_right")
    }
    padded = observe_detections(replace(demo.frame, **pad), replace(demo.detections, **masks))
    assert padded.equal(exact)


def test_without_masks_the_boxes_themselves_are_looked_at(demo: LoadedFrame, exact: Tensor) -> None:
    blind = masked(demo.detections, torch.zeros(len(demo.detections), dtype=torch.bool))
    without = observe_detections(demo.frame, blind)
    assert len(without) >= 3
    assert difference(without, OFFSET, exact) < 0.3


def test_the_refiner_corrects_frames_by_its_rig(demo: LoadedFrame) -> None:
    rig = RigEstimate.of_frames(demo.frame)
    rig.update(warped(demo.frame, 0.8, 0.0), demo.detections)
    corrected = rig.corrected(demo.frame)
    assert torch.equal(corrected.camera.disparity_field.coefficients, rig.field.coefficients)  # type: ignore[union-attr]
    assert rig.corrected(corrected) is corrected
    config = directshape_torch.load_config("fast", ["stages=[{max_iterations: 1}]", *EVERY_RESULT, *IMAGES_ALONE])
    by_rig = DirectShapeRefiner(config=config, rig=rig)(demo.frame, demo.detections)
    by_camera = DirectShapeRefiner(config=config)(corrected, rig.informed(corrected, demo.detections))
    assert torch.equal(by_rig.T_cam_obj, by_camera.T_cam_obj)
    K_left = demo.frame.camera.K_left.clone()
    K_left[:, 0, 0] += 3
    other = replace(demo.frame, camera=replace(demo.frame.camera, K_left=K_left))
    for use in (rig.corrected, lambda frames: rig.update(frames, demo.detections)):
        with pytest.raises(InputError, match="a difference of 3 px; estimate this rig"):
            use(other)


def test_what_an_estimate_of_few_cars_says_gives_way_to_settings_and_points(demo: LoadedFrame, exact: Tensor) -> None:
    rig = RigEstimate.of_frames(demo.frame)
    rig.add_rows(exact)
    matched = with_disparity(demo.frame)
    frames, plain = rig.corrected(matched), demo.detections.rows(torch.arange(2))
    informed = rig.informed(frames, plain)
    for config, heard in (
        (["priors.pose_sigma_yaw_deg=1"], replace(informed, pose_sigma=None)),
        # Points know no offset: the covariance keeps what it owes to the field.
        (POINTS_ALONE, replace(informed, offset_sigma_px=None)),
    ):
        once = ["stages=[{max_iterations: 1}]", *EVERY_RESULT]
        settings = directshape_torch.load_config("fast", [*once, *config])
        by_rig = DirectShapeRefiner(config=settings, rig=rig)(matched, plain)
        expected, other = (DirectShapeRefiner(config=settings)(frames, d) for d in (heard, informed))
        torch.testing.assert_close(by_rig.covariance, expected.covariance, rtol=0, atol=0, equal_nan=True)
        assert not bool(torch.isclose(by_rig.covariance, other.covariance).all())
        assert bool(by_rig.refined.any())
