"""Boxes aligned in depth return to where box-shaped cars were rendered, and nothing else of a box changes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import align_boxes as script
import pytest
import torch
from helpers.ellipsoids import CENTRE_OBJ, HALF_AXES, ellipsoid_prior
from helpers.synthetic_scene import TWO_CARS, Street, joined_detections, joined_frames, masked, select, street
from reference.rays import RaysObj

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rows import Rays
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.state.cars import CarState


@lru_cache
def box_street(dtype: torch.dtype = torch.float64) -> tuple[PCAShapePrior, Street]:
    """Two cars that are boxes of the mean dimensions."""
    prior = ellipsoid_prior()
    steps = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in prior.mean.shape), indexing="ij")
    points = prior.origin + prior.spacing_m * torch.stack(steps, dim=-1)
    q = (points - torch.tensor(CENTRE_OBJ).double()).abs() - torch.tensor(HALF_AXES).double()
    prior.mean.copy_(q.clamp_min(0).norm(dim=-1) + q.amax(dim=-1).clamp_max(0))
    prior = prior.to(dtype)
    return prior, street(prior, *TWO_CARS)


def aligned(frames: FrameBatch, detections: Detections) -> script.Aligned:
    refiner = DirectShapeRefiner(box_street(frames.images_left.dtype)[0], script.SETTINGS)
    return script.aligned(refiner, frames, detections)


def moved(detections: Detections, *factors: float) -> Detections:
    """Cars with multiplied depth along the viewing rays of their origins."""
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[:, :3, 3] *= torch.tensor(factors, dtype=T_cam_obj.dtype)[:, None]
    return replace(detections, T_cam_obj=T_cam_obj)


def test_disparity_moves_the_origin_along_its_viewing_ray() -> None:
    before = pose_from_kitti(
        torch.tensor([[2.0, 1.6, 20.0], [-4.0, 1.7, 35.0]]).double(), torch.tensor([0.4, -2.0]).double()
    )
    state = CarState.of(se3.inverse(before), torch.zeros(2, 3).double())
    focal_baseline = torch.tensor([380.0, 380.0]).double()
    after = se3.inverse(script.move_by_disparity(state, focal_baseline, 1.5).T_obj_cam)
    torch.testing.assert_close(380 / after[:, 2, 3], 380 / before[:, 2, 3] + 1.5)
    ratio = after[:, :3, 3] / before[:, :3, 3]
    torch.testing.assert_close(ratio, ratio[:, :1].expand(2, 3))
    torch.testing.assert_close(after[:, :3, :3], before[:, :3, :3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("factors", [(1.1, 0.85), (0.92, 1.15), (1.0, 1.0)])
def test_boxes_come_back_to_their_depth(dtype: torch.dtype, factors: tuple[float, float]) -> None:
    scene = box_street(dtype)[1]
    detections = moved(scene.detections, *factors)
    detections = replace(detections, dimensions_hwl=detections.dimensions_hwl * 1.01)
    result = aligned(scene.frames, detections)
    assert result.is_aligned.all()
    # A tenth of a pixel: the cars have disparities of 10 and 6 px.
    ratio = result.T_cam_obj[:, :3, 3] / detections.T_cam_obj[:, :3, 3]
    torch.testing.assert_close(ratio, ratio[:, :1].expand(-1, 3))
    torch.testing.assert_close(
        ratio[:, 0] * torch.tensor(factors).to(ratio), torch.ones_like(ratio[:, 0]), rtol=0, atol=0.01
    )
    torch.testing.assert_close(result.T_cam_obj[:, :3, :3], detections.T_cam_obj[:, :3, :3])


def test_a_batch_equals_a_loop() -> None:
    scene = box_street()[1]
    parts = moved(scene.detections, 1.1, 0.9), moved(scene.detections, 0.95, 1.1)
    together = aligned(joined_frames([scene.frames] * 2), joined_detections(list(parts), (120, 160)))
    alone = [aligned(scene.frames, select(part, torch.tensor([row]))) for part in parts for row in range(2)]
    torch.testing.assert_close(together.T_cam_obj, torch.cat([x.T_cam_obj for x in alone]), rtol=0, atol=1e-9)


def test_a_car_that_cannot_be_aligned_keeps_its_input_and_touches_no_other() -> None:
    scene = box_street()[1]
    frames, detections = scene.frames, moved(scene.detections, 1.1, 0.9)
    healthy = aligned(frames, detections)
    grey = torch.full_like(frames.images_left, 0.5)
    assert not aligned(replace(frames, images_left=grey, images_right=grey), detections).is_aligned.any()
    # Not up to its contour, where the neighbourhoods of the other car's pixels end.
    inner = 1 - torch.nn.functional.max_pool2d(1 - detections.mask_left.dense()[1:], 9, 1, 4)
    spoilt = replace(frames, images_left=torch.where(inner > 0.5, torch.nan, frames.images_left))
    first = torch.tensor([True, False])
    for some_frames, some in ((spoilt, detections), (frames, masked(detections, first, first))):
        result = aligned(some_frames, some)
        assert torch.equal(result.is_aligned, first)
        assert torch.equal(result.T_cam_obj[1], detections.T_cam_obj[1])
        torch.testing.assert_close(result.T_cam_obj[0], healthy.T_cam_obj[0], rtol=0, atol=1e-9)
    assert len(aligned(frames, select(detections, torch.arange(0))).T_cam_obj) == 0


def test_hits_are_where_rays_enter_the_lower_half_of_the_box() -> None:
    detections = box_street()[1].detections
    generator = torch.Generator().manual_seed(2)
    ray_cam = torch.randn(3, 2, 64, generator=generator, dtype=torch.float64) * 0.1
    ray_cam = ray_cam + (detections.T_cam_obj[:, :3, 3] / detections.T_cam_obj[:, 2:3, 3]).mT[..., None]
    T_obj_cam = se3.inverse(detections.T_cam_obj)
    hits = script.box_hits(
        Rays(torch.arange(2), torch.zeros(2, 3).double(), ray_cam), T_obj_cam, detections.dimensions_hwl
    )
    for car, (height, width, length) in enumerate(detections.dimensions_hwl.tolist()):
        corner = torch.tensor([length / 2, 0.0, width / 2]).double()
        bounds = torch.stack([-corner - torch.tensor([0, height, 0]), corner])
        T, rays = T_obj_cam[car], ray_cam[:, car].T
        direction = rays @ T[:3, :3].T
        near, _, hit = RaysObj(torch.empty(0), T[:3, 3].expand_as(direction), direction).interval(bounds)
        points = se3.transform(T, near[:, None] * rays)
        found = hit & (points[:, 1] > -height / 2)
        assert 5 < found.sum() < 60
        assert torch.equal(hits.found[car], found)
        torch.testing.assert_close(hits.depth[car][found], near[found])
        torch.testing.assert_close(hits.points_obj[:, car].T[found], points[found])
        # A face's normal is against the ray, and the point lies on that face.
        normal = hits.normal_obj[:, car].T[found]
        assert (normal.abs().sum(1) == 1).all()
        assert ((normal * (rays @ T[:3, :3].T)[found]).sum(1) < 0).all()
        face = torch.where(normal > 0, bounds[1], bounds[0])
        torch.testing.assert_close((points[found] - face)[normal != 0], torch.zeros(int(found.sum())).double())


def test_result_files_have_the_dimensions_and_headings_of_their_input(
    shared_kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = {"data": "", "detections": "detections", "masks": "masks"}
    words = [word for name, folder in folders.items() for word in (f"--{name}", str(shared_kitti / folder))]
    words += ["--frames", "0", "--out", str(tmp_path)]
    assert script.main(words) == 0
    before, after = (read_objects(folder / "data" / "000000.txt") for folder in (shared_kitti / "detections", tmp_path))
    assert len(before) == len(after)
    for old, new in zip(before, after, strict=True):
        assert (old.type, old.score, old.rotation_y) == (new.type, new.score, pytest.approx(new.rotation_y, abs=0.01))
        assert old.hwl == pytest.approx(new.hwl, abs=0.01)
    changed = [old.location_ref != new.location_ref for old, new in zip(before, after, strict=True)]
    assert capsys.readouterr().out.startswith(f"{sum(changed)} of ")
    assert any(changed)
    assert script.main([*words, "--rig", "auto"]) == 2
    assert "--rig: expected a file or none, got auto" in capsys.readouterr().err
