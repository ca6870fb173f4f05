"""Sizes of cars under masks show a rig, and boxes that were made of its own disparities do not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.bundled_frame import DEMO, MASKS
from helpers.rig_rows import SIZE_WH, estimate, rows_of_cars
from test_detections import OFFSET, closer, difference, warped
from torch import Tensor

from directshape_torch import Detections
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.rig.detections import observe_detections, observe_sizes
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.pixels import by_degree
from directshape_torch.rig.posterior import SIZE
from directshape_torch.rig.rig_file import load_rigs, save_rigs
from directshape_torch.scene.masks import MaskCrops

PLACES = torch.tensor([[200.0, 190], [450, 190], [620, 190], [800, 190], [1050, 190]], dtype=torch.float64)
SIZE_NOISE = 0.06


@pytest.fixture(scope="module")
def demo() -> LoadedFrame:
    """Six rendered cars with exact masks, and boxes that were made of these."""
    return open_dataset("kitti", DEMO, masks=MASKS).load("000000")


@pytest.fixture(scope="module")
def exact(demo: LoadedFrame) -> Tensor:
    """What the sizes of the cars show of the frame as it is."""
    rows: Tensor = observe_sizes(demo.frame, demo.detections)
    return rows


def cut(detections: Detections, rows: slice) -> Detections:
    """The detections whose masks are seen in some rows of the image only."""
    height, width = detections.mask_left.size_hw
    mask = torch.zeros(len(detections), height, width, dtype=torch.bool)
    for car in range(len(detections)):
        mask[car, rows] = detections.mask_left[car][rows] > 0.5
    return replace(detections, mask_left=MaskCrops.of(mask, name="mask_left"))


def test_sizes_see_what_the_right_image_is_warped_by(demo: LoadedFrame, exact: Tensor) -> None:
    assert len(exact) >= 4
    frames = warped(demo.frame, 0.8, 0.3)
    from_new_boxes = Detections.from_masks(frames, demo.detections.mask_left)
    for detections in (demo.detections, from_new_boxes):
        seen = observe_sizes(frames, detections)
        assert difference(seen, OFFSET, exact) == pytest.approx(0.8, abs=0.15)


def test_the_depth_of_a_box_made_of_masks_is_no_evidence(demo: LoadedFrame, exact: Tensor) -> None:
    assert not len(observe_detections(demo.frame, demo.detections))
    moved = observe_sizes(demo.frame, closer(demo.detections, 0.08))
    torch.testing.assert_close(moved[:, OFFSET], exact[:, OFFSET], rtol=0, atol=0.02)
    detector = replace(demo.detections, is_from_masks=None)
    apart = observe_detections(demo.frame, detector)[:, OFFSET].median()
    moved = observe_detections(demo.frame, closer(detector, 0.08))[:, OFFSET].median()
    assert float((moved - apart).abs()) > 0.5, "of a detector's box the depth is evidence"


def test_a_mask_of_unknown_height_says_nothing(demo: LoadedFrame, exact: Tensor) -> None:
    v_of_cars = exact[:, 1]
    half_hidden = cut(demo.detections, slice(0, int(v_of_cars.min()) - 1))
    assert not len(observe_sizes(demo.frame, half_hidden))
    height = demo.frame.images_left.shape[2]
    low = replace(demo.frame, sizes=torch.tensor([[int(v_of_cars.max()) + 1, demo.frame.images_left.shape[3]]]))
    assert height > int(v_of_cars.max()) + 1
    assert len(observe_sizes(low, demo.detections)) < len(exact)
    truck = replace(demo.detections, dimensions_hwl=demo.detections.dimensions_hwl / 1.4)
    assert not len(observe_sizes(demo.frame, truck))


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


def test_a_rig_of_files_without_detections_is_estimated_from_sizes(exact: Tensor) -> None:
    (rig,) = estimate_rigs(open_dataset("kitti", DEMO, masks=MASKS, ground="camera_height"))
    assert len(rig.sizes) == len(exact)
    assert not len(rig.rows)
    mean, sigma = rig.in_the_middle()
    assert abs(mean) < 2 * sigma
