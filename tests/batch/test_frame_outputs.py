"""Results of a frame end in the right files and lines, with the numbers of the zero level."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from directshape_torch.batch.frame_outputs import write_frame_outputs
from directshape_torch.batch.options import RefineOptions
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import result_path, shapes_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refinement.disparity_profile import DisparityProfile
from directshape_torch.refinement.observability import Observability
from directshape_torch.refinement.quality import FitQuality
from directshape_torch.result import RefinementResult
from directshape_torch.scene import Detections, FrameBatch, GroundPlane
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance
from directshape_torch.status import Status

T_CAM_REF = torch.tensor([0.06, -0.01, 0.003], dtype=torch.float64)
CAR = "Car -1 -1 0.1 5.25 6 70 80.5 1.4 1.7 4.1 1 1.6 20 0 0.930"
WALKER = "Pedestrian 0 0 0.5 1 2 3 4 1.8 0.6 0.6 1 1.7 9 0 0.5"


def box_prior() -> PCAShapePrior:
    """A box 4.0 m long, 1.5 m high and 1.6 m wide on the ground, whatever the code."""
    x, y, z = torch.meshgrid(
        torch.arange(-2.5, 2.6, 0.1), torch.arange(-2.0, 0.6, 0.1), torch.arange(-1.2, 1.3, 0.1), indexing="ij"
    )
    outside = torch.stack([x.abs() - 2.0, (y + 0.75).abs() - 0.75, z.abs() - 0.8])
    mean = outside.amax(dim=0).double()
    K = 2
    return PCAShapePrior(
        mean,
        torch.zeros(*mean.shape, K, dtype=torch.float64),
        torch.tensor([-2.5, -2.0, -1.2], dtype=torch.float64),
        0.1,
        explained_variance_ratio=torch.ones(K).double(),
        dimensions_mean_hwl=torch.tensor([1.5, 1.6, 4.0]).double(),
        dimensions_basis_hwl=torch.zeros(3, K).double(),
        dimensions_std_hwl=torch.ones(3).double(),
        provenance=PriorProvenance(made_by="test", licence="none", num_samples=0),
    )


def loaded_frame(objects: list[KittiObject], rows: tuple[int, ...], frame_id: str) -> LoadedFrame:
    B = sum(row >= 0 for row in rows)
    eye = torch.eye(3, dtype=torch.float64)[None]
    T_right_cam = torch.eye(4, dtype=torch.float64)[None]
    T_right_cam[0, 0, 3] = -0.54
    image = torch.zeros(1, 3, 4, 4)
    frame = FrameBatch(
        image,
        image,
        torch.tensor([[4, 4]]),
        StereoCamera(eye, eye, T_right_cam, T_CAM_REF[None]),
        GroundPlane.from_camera_height(1.65),
        (frame_id,),
    )
    none = torch.zeros(B, dtype=torch.bool)
    detections = Detections(
        torch.zeros(B, dtype=torch.int64),
        torch.eye(4).repeat(B, 1, 1),
        torch.ones(B, 3),
        torch.zeros(B, 4),
        torch.ones(B),
        torch.zeros(B, 4, 4),
        torch.zeros(B, 4, 4),
        none,
        none,
    )
    return LoadedFrame(frame, detections, objects, rows, None)


def result(statuses: list[Status]) -> RefinementResult:
    B = len(statuses)
    location_ref = torch.tensor([[float(k), 1.6, 10.0 + k] for k in range(B)], dtype=torch.float64).reshape(-1, 3)
    T_cam_obj = pose_from_kitti(location_ref + T_CAM_REF, torch.full((B,), 0.25, dtype=torch.float64))
    return RefinementResult(
        T_cam_obj=T_cam_obj,
        code=torch.arange(2.0 * B).reshape(B, 2).double(),
        status_code=torch.tensor([status.code for status in statuses], dtype=torch.int64),
        iterations=torch.arange(B),
        term_names=("silhouette", "shape"),
        cost_before=torch.ones(B, 2),
        cost_after=torch.zeros(B, 2),
        covariance=torch.eye(8).repeat(B, 1, 1),
        covariance_xyz_yaw=torch.eye(4).repeat(B, 1, 1),
        cost_history=torch.zeros(B, 3),
        quality=FitQuality.nothing(T_cam_obj, B),
        observability=Observability.nothing(T_cam_obj, B),
        profile=DisparityProfile.nothing(T_cam_obj, B),
        input_dimensions_hwl=torch.ones(B, 3, dtype=torch.float64),
        ground_source=("file",) * B,
        t_cam_ref=T_CAM_REF.expand(B, 3),
        track_part=torch.full((B,), -1),
        prior=box_prior(),
    )


def write_refinement(out_dir: Path, loaded: LoadedFrame, result: RefinementResult, prior_sha256: str) -> None:
    """Both files of a frame."""
    write_frame_outputs(out_dir, loaded, result, "", prior_sha256, {}, RefineOptions())


@pytest.fixture
def objects(tmp_path: Path) -> list[KittiObject]:
    path = tmp_path / "in.txt"
    path.write_text(f"{CAR}\n\n{WALKER}\n{CAR}\n{CAR}\n")
    return read_objects(path)


def test_one_frame(tmp_path: Path, objects: list[KittiObject]) -> None:
    loaded = loaded_frame(objects, (0, -1, 1, 2), "000007")
    statuses = [Status.converged, Status.no_mask, Status.max_iterations]
    write_refinement(tmp_path, loaded, result(statuses), "ab" * 32)
    lines = result_path(tmp_path, "000007").read_text().splitlines()
    alpha = 0.25 - math.atan2(0.0, 10.0)
    assert lines[0] == (f"Car -1 -1 {alpha:.4f} 5.25 6 70 80.5 1.5000 1.6000 4.0000 0.0000 1.6000 10.0000 0.2500 0.930")
    assert lines[1:3] == [WALKER, CAR]
    last = read_objects(result_path(tmp_path, "000007"))[3]
    assert last.location_ref == (2.0, 1.6, 12.0)
    assert last.alpha == pytest.approx(0.25 - math.atan2(2.0, 12.0), abs=1e-4)

    shapes = read_shapes(shapes_path(tmp_path, "000007"))
    assert shapes.frame_id == "000007"
    assert shapes.ground_source == "camera_height"
    assert shapes.prior_sha256 == "ab" * 32
    # Line numbers of the file, which has a blank second line.
    assert shapes.input_lines.tolist() == [1, 4, 5]
    assert shapes.statuses == ("converged", "no_mask", "max_iterations")
    assert shapes.messages[1] == Status.no_mask.value
    np.testing.assert_allclose(shapes.T_ref_obj[2, :3, 3], [2.0, 1.6, 12.0])
    np.testing.assert_allclose(shapes.T_cam_obj[2, :3, 3], [2.06, 1.59, 12.003])
    np.testing.assert_allclose(shapes.boxes_hwl, [[1.5, 1.6, 4.0], [1.0, 1.0, 1.0], [1.5, 1.6, 4.0]], atol=1e-6)
    assert shapes.codes.tolist() == [[0, 1], [2, 3], [4, 5]]


def test_no_cars(tmp_path: Path, objects: list[KittiObject]) -> None:
    write_refinement(tmp_path, loaded_frame(objects[1:2], (-1,), "000003"), result([]), "")
    assert result_path(tmp_path, "000003").read_text() == f"{WALKER}\n"
    assert read_shapes(shapes_path(tmp_path, "000003")).codes.shape == (0, 2)


def test_equal_results_give_equal_bytes(tmp_path: Path, objects: list[KittiObject]) -> None:
    loaded = loaded_frame(objects, (0, -1, 1, 2), "000007")
    for folder in ("a", "b"):
        write_refinement(tmp_path / folder, loaded, result([Status.converged] * 3), "")
    for path in (result_path, shapes_path):
        assert path(tmp_path / "a", "000007").read_bytes() == path(tmp_path / "b", "000007").read_bytes()
