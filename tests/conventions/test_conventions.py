"""Each numbered sentence of CONVENTIONS.md has one test, and one test checks that the numbers match."""

from __future__ import annotations

import ast
import inspect
import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.ground import cars_on
from helpers.lookup import bilinear_with_gradient
from helpers.problems import DEFAULT, begun_stage, figures_at, left_of, photometric_of
from helpers.synthetic_scene import cached_street, disturbed
from kornia.geometry.liegroup import So3
from torch import Tensor

from directshape_torch.geometry import box3d, se3
from directshape_torch.geometry.projection import project, rays_from_pixels, right_rays
from directshape_torch.geometry.stereo_depth import warp_to_right
from directshape_torch.image.grey_levels import grey_levels, halve
from directshape_torch.io.kitti_calibration import KittiCalibration, plane_ref_to_cam, read_plane, to_stereo_camera
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import write_result_text
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.shape_prior import DimensionsDerivative, SdfDerivatives
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.state.cars import CarState
from directshape_torch.terms.depth import march
from directshape_torch.terms.photometric_rows import DSO_PATTERN
from directshape_torch.terms.priors import dimensions_prior, height_prior, shape_prior
from directshape_torch.terms.silhouette import product_residual, sdf_state_jacobian

ROOT = Path(__file__).parents[2]
K = torch.tensor([[720.0, 0.0, 610.0], [0.0, 720.0, 172.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
# KITTI-like projections with all components of the fourth columns: u, v and depth offsets of both cameras.
P2 = torch.cat([K, K @ torch.tensor([[0.06], [-0.0003], [0.0027]], dtype=torch.float64)], dim=1)
P3 = torch.cat([K, K @ torch.tensor([[-0.473], [0.0024], [0.0030]], dtype=torch.float64)], dim=1)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def camera():  # type: ignore[no-untyped-def]
    calibration = KittiCalibration(Path("calib.txt"), P2.numpy(), P3.numpy())
    return to_stereo_camera(calibration)


def sentences() -> list[int]:
    text = (ROOT / "CONVENTIONS.md").read_text(encoding="utf-8")
    return [int(number) for number in re.findall(r"^(\d+)\. ", text, flags=re.MULTILINE)]


def test_numbers_in_file_and_tests_match() -> None:
    numbers = sentences()
    assert numbers == list(range(1, len(numbers) + 1))
    names = [name for name, _ in inspect.getmembers(sys.modules[__name__], inspect.isfunction)]
    tested = [int(match[1]) for name in names if (match := re.fullmatch(r"test_(\d\d)_\w+", name))]
    assert sorted(tested) == numbers


def test_01_transforms_are_named_to_from() -> None:
    T_cam_obj = box3d.pose_from_kitti(vector(1.0, 1.6, 20.0), torch.tensor(0.3).double())
    # The object's origin has the coordinates of its location in the camera frame.
    torch.testing.assert_close(se3.transform(T_cam_obj, vector(0, 0, 0)), vector(1.0, 1.6, 20.0))
    T_right_cam = camera().T_right_cam[0]
    point_obj = vector(1.2, -0.7, 0.4)
    in_steps = se3.transform(T_right_cam, se3.transform(T_cam_obj, point_obj))
    torch.testing.assert_close(se3.transform(T_right_cam @ T_cam_obj, point_obj), in_steps)


def test_02_forbidden_names_do_not_occur() -> None:
    used = set()
    for path in (ROOT / "directshape_torch").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for attribute in ("id", "arg", "attr", "name"):
                name = getattr(node, attribute, None)
                if isinstance(name, str):
                    used.add(name)
    assert len(used) > 500
    assert not used & {"pose", "poses", "extrinsic", "extrinsics", "w2c", "c2w"}
    assert {"points_obj", "points_cam", "centre_obj"} <= used


def test_03_ref_is_rectified_camera_0() -> None:
    """A point that P2 sees at a pixel, with `ref` coordinates, is the point that `cam` sees there."""
    point_ref = vector(2.0, 1.0, 15.0)
    homogeneous = P2 @ torch.cat([point_ref, vector(1.0)])
    by_kitti = homogeneous[:2] / homogeneous[2]
    rig = camera()
    torch.testing.assert_close(project(point_ref + rig.t_cam_ref[0], rig.K_left[0]), by_kitti)


def test_04_cam_is_x_right_y_down_z_forward() -> None:
    centre, right, below = project(torch.tensor([[0.0, 0, 10], [1, 0, 10], [0, 1, 10]]).double(), K)
    assert right[0] > centre[0]
    assert below[1] > centre[1]
    assert rays_from_pixels(centre, K)[2] == 1


def test_05_right_camera_stands_to_the_right() -> None:
    rig = camera()
    origin = right_rays(vector(600, 170), rig.K_right[0], rig.T_right_cam[0]).origin_cam
    assert 0.5 < float(origin[0]) < 0.6
    assert float(rig.baseline[0]) == pytest.approx(0.533)


def test_06_obj_is_kittis_object_frame() -> None:
    T = box3d.pose_from_kitti(vector(0, 1.65, 20), torch.tensor(0.0).double())
    assert torch.equal(T[:3, :3], torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.cross(T[:3, 0], T[:3, 1]), T[:3, 2])
    corners = box3d.box_corners(T, vector(1.5, 1.6, 4.0))
    # Length along x, height along -y from the ground at y = 1.65, width along z.
    torch.testing.assert_close(corners.amin(0), vector(-2.0, 0.15, 19.2))
    torch.testing.assert_close(corners.amax(0), vector(2.0, 1.65, 20.8))
    lower, upper = ellipsoid_prior().bounds_obj
    assert lower[1] < -1.5 < 0 < upper[1]


def test_07_cam_from_ref_comes_from_the_fourth_column_of_p2() -> None:
    rig = camera()
    torch.testing.assert_close(rig.K_left[0], K)
    torch.testing.assert_close(rig.t_cam_ref[0], vector(0.06, -0.0003, 0.0027))


def test_08_right_from_cam_has_all_three_components() -> None:
    T = camera().T_right_cam[0]
    torch.testing.assert_close(T[:3, 3], vector(-0.533, 0.0027, 0.0003))
    assert torch.equal(T[:3, :3], torch.eye(3, dtype=torch.float64))


def test_09_planes_point_up_and_move_with_the_camera(tmp_path: Path) -> None:
    path = tmp_path / "plane.txt"
    path.write_text("# Plane\nWidth 4\nHeight 1\n0.02 2.0 0.0 -3.3\n", encoding="utf-8")
    plane_ref = read_plane(path)
    assert plane_ref[1] < 0
    assert np.linalg.norm(plane_ref[:3]) == pytest.approx(1)
    assert plane_ref[3] == pytest.approx(1.65, abs=1e-3)
    on_ground_ref = np.array([4.0, 0.0, 11.0])
    on_ground_ref[1] = -(plane_ref[[0, 2]] @ on_ground_ref[[0, 2]] + plane_ref[3]) / plane_ref[1]
    t_cam_ref = camera().t_cam_ref[0].numpy()
    normal, offset_ref = torch.from_numpy(plane_ref[:3]), torch.tensor(plane_ref[3])
    offset_cam = plane_ref_to_cam(normal, offset_ref, torch.from_numpy(t_cam_ref))
    assert abs(plane_ref[:3] @ (on_ground_ref + t_cam_ref) + offset_cam.item()) < 1e-12


def result_at(code: Tensor, rotation_y: float) -> RefinementResult:
    prior, scene = cached_street()
    result = DirectShapeRefiner(prior, DEFAULT)(scene.frames, scene.detections)
    T = box3d.pose_from_kitti(vector(2.0, 1.7, 14.0), torch.tensor(rotation_y).double())
    return replace(result, T_cam_obj=T.expand(2, 4, 4), code=code.expand(2, 3))


def test_10_dimensions_are_extents_of_the_zero_level() -> None:
    """Half axes 1.95, 0.75, 0.80 m on a grid of 0.2 m: known to a small part of a voxel, and following the code."""
    mean = result_at(vector(0, 0, 0), 0.4).boxes().dimensions_hwl[0]
    torch.testing.assert_close(mean, vector(1.5, 1.6, 3.9), atol=0.02, rtol=0)
    longer = result_at(vector(1, 0, 0), 0.4).boxes().dimensions_hwl[0]
    torch.testing.assert_close(longer - mean, vector(0, 0, 0.24), atol=0.02, rtol=0)


def test_11_location_is_the_bottom_centre_of_the_zero_level() -> None:
    result = result_at(vector(0, 0, 0), 0.4)
    shifted = ellipsoid_prior()
    shifted.origin += vector(0.3, -0.1, 0.2)  # the level no longer stands on the origin of its frame
    boxes = replace(result, prior=shifted).boxes()
    expected_cam = se3.transform(result.T_cam_obj[0], vector(0.3, -0.1, 0.2))
    expected_ref = expected_cam - cached_street()[1].frames.camera.t_cam_ref[0]
    torch.testing.assert_close(boxes.location_ref[0], expected_ref, atol=0.01, rtol=0)


def test_12_heading_and_observation_angle() -> None:
    boxes = result_at(vector(0, 0, 0), 2.9).boxes()
    R = box3d.rotation_about_y(torch.tensor(2.9).double())
    assert float(boxes.rotation_y[0]) == pytest.approx(math.atan2(-R[2, 0], R[0, 0])) == pytest.approx(2.9)
    x, _, z = boxes.location_ref[0].tolist()
    assert float(boxes.alpha[0]) == pytest.approx(2.9 - math.atan2(x, z))
    behind_left = box3d.alpha_from_kitti(vector(-10, 1.6, 10), torch.tensor(2.9).double())
    assert float(behind_left) == pytest.approx(2.9 + math.pi / 4 - 2 * math.pi)


def test_13_result_files_keep_what_is_not_refined(tmp_path: Path) -> None:
    lines = [
        "Pedestrian 0.00 0 -0.2 712.40 143.00 810.73 307.92 1.89 0.48 1.20 1.84 1.47 8.41 0.01 0.5001",
        "Car 0.10 1 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57 0.93",
        "Car 0 0 0 1 2 30 40 1.5  1.6 3.9 0 1.6 20 0 0.25",
    ]
    source, target = tmp_path / "in.txt", tmp_path / "out.txt"
    source.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    box = (1.7753, 1.4, 1.7, 4.1, -16.1, 2.3, 57.0, 1.5)
    write_result_text(target, read_objects(source), {1: box})
    written = target.read_text(encoding="utf-8").splitlines()
    assert (written[0], written[2]) == (lines[0], lines[2])
    before, after = lines[1].split(), written[1].split()
    assert before[:3] + before[4:8] + before[15:] == after[:3] + after[4:8] + after[15:]
    assert [float(x) for x in after[3:4] + after[8:15]] == [1.7753, 1.4, 1.7, 4.1, -16.1, 2.3, 57.0, 1.5]


def test_14_tangent_is_v_omega_dcode() -> None:
    state = CarState.of(torch.eye(4).double()[None], torch.zeros(1, 3).double())
    moved = state.unknowns.retract(state, vector(0.1, 0.2, 0.3, 0, 0, 0, 1, 2, 3)[None])
    torch.testing.assert_close(moved.T_obj_cam[0, :3, 3], vector(0.1, 0.2, 0.3))
    torch.testing.assert_close(moved.code[0], vector(1, 2, 3))
    turned = state.unknowns.retract(state, vector(0, 0, 0, 0, 0, math.pi / 2, 0, 0, 0)[None])
    torch.testing.assert_close(turned.T_obj_cam[0, :3, 0], vector(0, 1, 0))
    unsure = CarState.of(*state[:2], num_offsets=1)
    assert (state.unknowns.size, unsure.unknowns.size) == (9, 10)
    offset = unsure.unknowns.retract(unsure, vector(0, 0, 0, 0, 0, 0, 1, 2, 3, 0.4)[None])
    assert torch.equal(offset.code, moved.code)
    assert offset.offset_px.tolist() == [[0.4]]


def test_15_update_is_on_the_left_and_in_one_place() -> None:
    T_cam_obj = box3d.pose_from_kitti(vector(3, 1.6, 25), torch.tensor(0.7).double())
    state = CarState.of(se3.inverse(T_cam_obj)[None], torch.zeros(1, 2).double())
    delta = vector(0.2, 0.0, -0.1, 0.01, 0.3, 0.02, 0, 0)
    after = state.unknowns.retract(state, delta[None]).T_obj_cam[0]
    torch.testing.assert_close(after, se3.exp(delta[:6]) @ state.T_obj_cam[0])
    turned = state.unknowns.retract(state, vector(0, 0, 0, 0, 0.3, 0, 0, 0)[None]).T_obj_cam[0]
    torch.testing.assert_close(se3.inverse(turned)[:3, 3], T_cam_obj[:3, 3])
    callers = {
        path.name
        for path in (ROOT / "directshape_torch").rglob("*.py")
        if "se3.exp(" in path.read_text(encoding="utf-8")
    }
    # The laboratory has a camera drive a curve with it.
    assert callers == {"unknowns.py", "bench.py"}


def test_16_the_code_is_whitened() -> None:
    code = torch.tensor([[0.5, -2.0, 1.0]], dtype=torch.float64)
    assert torch.equal(shape_prior(code).residual, code)
    prior = ellipsoid_prior()
    torch.testing.assert_close(prior.values(code) - prior.mean, (prior.basis @ code[0])[None])


def test_17_signed_distances_are_negative_inside() -> None:
    prior = ellipsoid_prior()
    points = torch.tensor([[0.3, -0.75, 0.1], [0.0, -0.75, 1.3]], dtype=torch.float64)
    inside, outside = prior.bind(prior.initial_code(1)).value(points, torch.zeros(2, dtype=torch.long))
    assert inside < 0
    assert float(outside) == pytest.approx(0.5, abs=0.02)
    # With the paper's Phi = -sdf, pi = 1 - prod 1 / (exp(Phi zeta) + 1): inside the car the ray hits.
    # r = -log pi for a pixel that is surely foreground.
    hit = torch.exp(-product_residual(torch.stack([inside, outside])[None], vector(30.0), vector(1.0 - 1e-15))[0])
    assert hit[0] > 0.99
    assert hit[1] < 0.01


def test_18_pixels_are_column_row_with_centres_at_integers() -> None:
    image = torch.tensor([[[0.0, 2.0, 4.0], [10.0, 12.0, 14.0]]])
    uv = torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    value, gradient, _ = bilinear_with_gradient(image, torch.zeros(3, dtype=torch.long), uv)
    assert value.tolist() == [0.0, 4.0, 10.0]
    assert gradient[0].tolist() == [2.0, 10.0]
    torch.testing.assert_close(rays_from_pixels(K[:2, 2], K), vector(0, 0, 1))


def test_19_photometry_is_in_grey_levels() -> None:
    rgb = torch.eye(3, dtype=torch.float64).reshape(1, 3, 1, 3)
    torch.testing.assert_close(grey_levels(rgb).flatten(), 255 * vector(0.299, 0.587, 0.114))


def test_20_pyramid_is_the_2x2_mean_with_its_intrinsics() -> None:
    image = torch.tensor([[1.0, 3.0], [5.0, 7.0]]).reshape(1, 1, 2, 2)
    assert halve(image).item() == 4.0
    # Where a point appears, by an image whose values are its own columns: the coarse pixel 0 covers the fine ones 0 and
    # 1, so its centre is at 0.5.
    coarse = torch.diag(vector(0.5, 0.5, 1)) @ K
    coarse[:2, 2] = (K[:2, 2] + 0.5) / 2 - 0.5
    point = vector(1.0, -0.5, 9.0)
    columns = torch.arange(1242.0, dtype=torch.float64).repeat(1, 1, 2, 1)
    level = halve(columns)[0, :, 0]
    u = project(point, coarse)[0]
    left = int(u)
    torch.testing.assert_close(torch.lerp(level[0, left], level[0, left + 1], u - left), project(point, K)[0])


def test_21_bias_is_measured_minus_true_disparity() -> None:
    rig = camera()
    ray = rays_from_pixels(vector(640, 180), K)
    args = (ray, torch.tensor(20.0).double(), rig.K_right[0], rig.T_right_cam[0])
    true, measured = (warp_to_right(*args, bias).uv_right for bias in (None, torch.tensor(0.4).double()))
    true_disparity, measured_disparity = 640 - true[0], 640 - measured[0]
    assert float(measured_disparity - true_disparity) == pytest.approx(0.4)


def test_22_jacobians_are_out_in() -> None:
    gradient, X = vector(0.1, -0.6, 0.7), vector(1.0, -0.8, 0.4)
    points = X.view(3, 1, 1)
    at = SdfDerivatives(torch.zeros(1, 1), gradient.view(3, 1, 1), torch.zeros(1, 1, 2).double())
    J_sdf_point = gradient[None]
    J_point_state = torch.cat([torch.eye(3).double(), -So3.hat(X)], dim=1)  # of v + omega x X
    J_sdf_state = sdf_state_jacobian(points, at.gradient, at)[0]
    torch.testing.assert_close(J_sdf_state[:, :6], J_sdf_point @ J_point_state)
    assert J_sdf_state.shape == (1, 8)


def test_23_residuals_are_predicted_minus_observed() -> None:
    one = torch.ones(1, 3, dtype=torch.float64)
    shape_is_larger = dimensions_prior(DimensionsDerivative(2 * one, 0 * one[:, :, None]), one, one[0])
    assert (shape_is_larger.residual > 0).all()
    # A car predicted lower (greater y) than the ground: positive.
    T = se3.inverse(box3d.pose_from_kitti(vector(0, 1.9, 10), torch.tensor(0.0).double()))[None]
    assert height_prior(cars_on(vector(0, -1, 0), vector(1.65), 1), CarState.of(T, torch.zeros(1, 0))).residual > 0
    prior, scene = cached_street()
    darker_left = replace(scene.frames, images_left=scene.frames.images_left - 0.1)
    config = replace(DEFAULT, photometric=replace(DEFAULT.photometric, brightness="none"))
    stage, state = begun_stage(prior, darker_left, scene.detections, config)
    part = stage.photometric_part(figures_at(stage, CarState.of(state.T_obj_cam, scene.code)))
    assert part is not None
    counted = photometric_of(stage).row_weight > 0
    assert float(part.residual[counted].median()) == pytest.approx(25.5, abs=3)  # right minus left


def test_24_the_step_solves_h_delta_equals_minus_g() -> None:
    H = torch.tensor([[[4.0, 1.0], [1.0, 3.0]]], dtype=torch.float64)
    g = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    step, _ = damped_step(H, g, torch.zeros(1, dtype=torch.float64))
    torch.testing.assert_close((H @ step[..., None])[..., 0], -g)


def test_25_letters() -> None:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    B, K_, F = len(scene.detections), prior.num_codes, len(scene.frames)
    D, S, N = 6 + K_, DEFAULT.silhouette.samples_per_ray, len(DSO_PATTERN)
    term, prepared = photometric_of(stage), stage.problem.prepare(state)
    P = len(left_of(stage).pixels)
    H, W = scene.frames.images_left.shape[2:]
    assert left_of(stage).pixels.uv.shape == (P, 2)
    left, _ = stage.problem.masks.of_sides
    owner, rays = left.owner, left.in_objects(state.T_obj_cam)
    assert march(prepared.field, owner, rays, prior.bounds_obj, S).sdf.shape == (S, len(owner), 64)
    assert len(term.pixel_set.rows.intensity_left) == N == 8
    _, at = stage.start(prepared)
    assert (at.cost.shape, at.gradient.shape, at.hessian.shape) == ((B,), (B, D), (B, D, D))
    assert scene.frames.images_left.shape == (F, 3, H, W)
    assert scene.detections.mask_left.dense().shape == (B, H, W)


def test_26_systems_are_float64() -> None:
    scene = cached_street()[1]
    stage, state = begun_stage(
        ellipsoid_prior(torch.float32), scene.frames.to(dtype=torch.float32), scene.detections.to(dtype=torch.float32)
    )
    _, at = stage.start(stage.problem.prepare(state))
    assert at.cost.dtype == at.gradient.dtype == at.hessian.dtype == torch.float64
    assert left_of(stage).pixels.uv.dtype == state.code.dtype == torch.float32


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_27_results_follow_the_inputs(dtype: torch.dtype) -> None:
    scene = cached_street()[1]
    module = DirectShapeRefiner(ellipsoid_prior(), DEFAULT).to(dtype)
    result = module(scene.frames.to(dtype=dtype), disturbed(scene.detections).to(dtype=dtype))
    assert result.T_cam_obj.dtype == result.code.dtype == result.boxes().location_ref.dtype == dtype
    assert result.T_cam_obj.device == scene.detections.T_cam_obj.device
    assert result.refined.all()
    assert box3d.wrap_angle(torch.ones(1).bfloat16()).dtype == torch.float32
