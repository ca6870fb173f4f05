"""Detections and sizes of cars in a rendered frame show the offset by which its right image is warped."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.bundled_frame import DEMO, MASKS, with_true_boxes
from helpers.quick_runs import EVERY_RESULT, IMAGES_ALONE
from helpers.rig_rows import SIZE_WH, estimate, rows_of_cars
from helpers.synthetic_scene import masked
from torch import Tensor

import directshape_torch
from directshape_torch import Detections, DirectShapeRefiner, RigEstimate, check_scene
from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.rig.detections import observe_detections, observe_sizes, size_error
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.pixels import by_degree
from directshape_torch.rig.posterior import SIZE
from directshape_torch.rig.rig_file import load_rigs, save_rigs
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops
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


PLACES = torch.tensor([[200.0, 190], [450, 190], [620, 190], [800, 190], [1050, 190]], dtype=torch.float64)
SIZE_NOISE = 0.06


@pytest.fixture(scope="module")
def made_of_masks() -> LoadedFrame:
    """Six rendered cars with exact_sizes masks, and boxes that were made of these."""
    return open_dataset("kitti", DEMO, masks=MASKS).load("000000")


@pytest.fixture(scope="module")
def exact_sizes(made_of_masks: LoadedFrame) -> Tensor:
    """What the sizes of the cars show of the frame as it is."""
    rows: Tensor = observe_sizes(made_of_masks.frame, made_of_masks.detections)
    return rows


def cut(detections: Detections, rows: slice) -> Detections:
    """The detections whose masks are seen in some rows of the image only."""
    height, width = detections.mask_left.size_hw
    mask = torch.zeros(len(detections), height, width, dtype=torch.bool)
    for car in range(len(detections)):
        mask[car, rows] = detections.mask_left[car][rows] > 0.5
    return replace(detections, mask_left=MaskCrops.of(mask, name="mask_left"))


def test_sizes_see_what_the_right_image_is_warped_by(made_of_masks: LoadedFrame, exact_sizes: Tensor) -> None:
    assert len(exact_sizes) >= 4
    frames = warped(made_of_masks.frame, 0.8, 0.3)
    from_new_boxes = Detections.from_masks(frames, made_of_masks.detections.mask_left)
    for detections in (made_of_masks.detections, from_new_boxes):
        seen = observe_sizes(frames, detections)
        assert difference(seen, OFFSET, exact_sizes) == pytest.approx(0.8, abs=0.15)


def test_the_depth_of_a_box_made_of_masks_is_no_evidence(made_of_masks: LoadedFrame, exact_sizes: Tensor) -> None:
    assert not len(observe_detections(made_of_masks.frame, made_of_masks.detections))
    moved = observe_sizes(made_of_masks.frame, closer(made_of_masks.detections, 0.08))
    torch.testing.assert_close(moved[:, OFFSET], exact_sizes[:, OFFSET], rtol=0, atol=0.02)
    detector = replace(made_of_masks.detections, is_from_masks=None)
    apart = observe_detections(made_of_masks.frame, detector)[:, OFFSET].median()
    moved = observe_detections(made_of_masks.frame, closer(detector, 0.08))[:, OFFSET].median()
    assert float((moved - apart).abs()) > 0.5, "of a detector's box the depth is evidence"


def test_a_mask_of_unknown_height_says_nothing(made_of_masks: LoadedFrame, exact_sizes: Tensor) -> None:
    v_of_cars = exact_sizes[:, 1]
    half_hidden = cut(made_of_masks.detections, slice(0, int(v_of_cars.min()) - 1))
    assert not len(observe_sizes(made_of_masks.frame, half_hidden))
    height = made_of_masks.frame.images_left.shape[2]
    low = replace(
        made_of_masks.frame, sizes=torch.tensor([[int(v_of_cars.max()) + 1, made_of_masks.frame.images_left.shape[3]]])
    )
    assert height > int(v_of_cars.max()) + 1
    assert len(observe_sizes(low, made_of_masks.detections)) < len(exact_sizes)
    truck = replace(made_of_masks.detections, dimensions_hwl=made_of_masks.detections.dimensions_hwl / 1.4)
    assert not len(observe_sizes(made_of_masks.frame, truck))


def test_errors_are_as_large_as_the_estimate_says() -> None:
    """Standardised errors over draws of 60 cars behind other rigs, in streets whose cars differ in their mean size."""
    z, errors = [], []
    draw, sigma_px = torch.Generator().manual_seed(0), by_degree((0.4, 0.4, 0.5, 0.3, 0.5))
    for seed in range(24):
        share = (1.0, 0.5, 0.25, 0.05)[seed % 4]
        field = share * sigma_px * torch.randn(len(sigma_px), generator=draw, dtype=torch.float64)
        taller = 0.04 * float(torch.randn(1, generator=draw))
        rig = estimate(sizes=rows_of_cars(60, seed, bias=taller, noise=SIZE_NOISE, field=field))
        mean, sigma = rig.offset_at(PLACES)
        z.append((mean - polynomial_basis(PLACES, SIZE_WH) @ field) / sigma)
        errors.append((float(rig.mean[SIZE]) - taller) / float(rig.covariance[SIZE, SIZE].sqrt()))
    standardised = torch.stack(z)
    assert 0.5 < float(standardised.square().mean().sqrt()) < 1.3
    assert float((standardised.abs() < 2).double().mean()) > 0.9
    assert 0.4 < float(torch.tensor(errors).square().mean().sqrt()) < 1.3


def test_a_street_of_small_cars_is_no_biased_detector() -> None:
    """The mean size and the detector's bias are different unknowns, and both kinds of evidence add up."""
    alone, both = estimate(rows_of_cars(60, 0, bias=0.02)), estimate(rows_of_cars(60, 0, bias=0.02))
    both.add_sizes(rows_of_cars(200, 1, bias=-0.06, noise=SIZE_NOISE))
    assert both.detector.bias == pytest.approx(0.02, abs=2.5 * both.detector.bias_sigma)
    assert float(both.mean[SIZE]) == pytest.approx(-0.06, abs=0.03)
    assert both.in_the_middle()[1] < alone.in_the_middle()[1]
    assert "60 detections, the sizes of 200 cars" in str(both)
    assert estimate(sizes=rows_of_cars(29, 0)).is_guess
    assert not estimate(sizes=rows_of_cars(30, 0)).is_guess


def test_files_keep_sizes_and_earlier_files_have_none(tmp_path: Path) -> None:
    path, rig = tmp_path / "rig.json", estimate(sizes=rows_of_cars(20, 2))
    save_rigs(path, [rig])
    assert torch.equal(load_rigs(path)[0].mean, rig.mean)
    content = json.loads(path.read_text())
    del content["rigs"][0]["sizes"]
    path.write_text(json.dumps(content))
    assert not len(load_rigs(path)[0].sizes)


def test_a_rig_of_files_without_detections_is_estimated_from_sizes(exact_sizes: Tensor) -> None:
    (rig,) = estimate_rigs(open_dataset("kitti", DEMO, masks=MASKS, ground="camera_height"))
    assert len(rig.sizes) == len(exact_sizes)
    assert not len(rig.rows)
    mean, sigma = rig.in_the_middle()
    assert abs(mean) < 2 * sigma
