"""Shapes of a whole refinement are compared with true surfaces of a tiny street and of a real frame."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.kitti_folder import CODE, input_options, write_data_set, write_disparity
from helpers.synthetic_scene import TWO_CARS, street

from directshape_torch.cli.main import main
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation import matching
from directshape_torch.evaluation.evaluate_shapes import ShapeScores, evaluate_shapes
from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.stereo_depth import depth_from_disparity
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.io.kitti_labels import poses_cam, read_objects
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.pca_prior import PCAShapePrior

FRAMES = ("000000", "000001")
T_CAM_OBJ = pose_from_kitti(torch.tensor(TWO_CARS[0], dtype=torch.float64), torch.tensor(TWO_CARS[1]).double())


def write_truth(root: Path, prior: PCAShapePrior) -> None:
    """Write true disparities and depths without the library's ray casting; the cars are the same in every frame."""
    scene = street(prior, *TWO_CARS, code=torch.tensor(CODE, dtype=torch.float64))
    camera, disparity = scene.frames.camera, scene.disparity[0]
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    uv = torch.stack([u, v], dim=-1).double()
    depth = depth_from_disparity(uv, disparity, camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])
    for frame_id in FRAMES:
        for folder, values in (("disp_occ_0", disparity), ("depth_2", depth)):
            write_disparity(root / "training" / folder / f"{frame_id}.png", values.numpy())


def write_perfect(source: Path, target: Path) -> None:
    """Write the shape files of `source` with the true poses and codes."""
    for frame_id in FRAMES:
        shapes = read_shapes(source / "shapes" / f"{frame_id}.npz")
        perfect = dataclasses.replace(shapes, codes=np.array(CODE), T_cam_obj=T_CAM_OBJ.numpy())
        write_shapes(target / "shapes" / f"{frame_id}.npz", perfect)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with `refined` (one step of a refinement) and `perfect` results."""
    root = tmp_path_factory.mktemp("kitti")
    prior = write_data_set(root, FRAMES)
    write_truth(root, prior)
    options = ["--out", str(root / "refined"), "--rig", "none", "--set", "stages=[{max_iterations: 1}]"]
    assert main(["refine", *input_options(root), *options]) == 0
    write_perfect(root / "refined", root / "perfect")
    return root


def evaluate(root: Path, refined: str = "perfect", **options: Any) -> ShapeScores:
    settings: dict[str, Any] = {"num_draws": 200, "masks": root / "masks"} | options
    prior = load_prior(root / "prior.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "_LEAST_HEIGHT_PX", 10.0)  # the second car is 18 px high
        return evaluate_shapes(root, root / "detections", root / refined, prior, **settings)


def command(root: Path, refined: Path, *extra: str) -> list[str]:
    words = ["evaluate-shape", "--data", root, "--detections", root / "detections", "--refined", refined]
    words += ["--masks", root / "masks", "--prior", root / "prior.safetensors", "--draws", 200]
    return [*map(str, words), *extra]


def test_the_truth_itself_is_perfect_on_segments(root: Path) -> None:
    scores = evaluate(root)
    assert (scores.num_frames, scores.num_labels_counted) == (2, 4)
    assert (scores.num_without_truth, scores.num_without_detection, len(scores.cars)) == (0, 0, 4)
    assert [(car.frame_id, car.detection_line, car.label_line) for car in scores.cars] == [
        (frame_id, line, label) for frame_id in FRAMES for line, label in ((1, 1), (3, 2))
    ]
    for car in scores.cars:
        error = car.after
        # Disparities are rounded to 1/256 px, up to 4 mm at 12.5 m.
        assert error.completeness[0] > 0.99
        assert error.accuracy[0] > 0.99
        assert error.rmse_m[0] < 0.01
        assert car.before.completeness[0] < 0.9


def test_depths_say_the_same_as_disparities(root: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(root, tmp_path / "kitti"))
    by_disparity = evaluate(copy, "refined")
    shutil.rmtree(copy / "training" / "disp_occ_0")
    for a, b in zip(by_disparity.cars, evaluate(copy, "refined").cars, strict=True):
        assert a.after.num_true == b.after.num_true
        np.testing.assert_allclose(a.after.f1, b.after.f1, atol=0.01)


def test_a_car_moved_by_a_known_amount(root: Path, tmp_path: Path) -> None:
    """0.3 m along the optical axis: the point of a ray moves by 0.3 m / (share of the ray's slant), so hardly any
    distance to the moved surface exceeds 0.3 m, and none falls below what the surface's slant allows."""
    for frame_id in FRAMES:
        shapes = read_shapes(root / "perfect" / "shapes" / f"{frame_id}.npz")
        moved = shapes.T_cam_obj.copy()
        moved[:, 2, 3] += 0.3
        write_shapes(tmp_path / "shapes" / f"{frame_id}.npz", dataclasses.replace(shapes, T_cam_obj=moved))
    for car in evaluate(root, refined=str(tmp_path)).cars:
        error = car.after
        assert error.completeness[5] > 0.9  # tau 0.3 m
        assert error.completeness[0] < 0.25  # tau 0.05 m
        assert 0.15 < error.rmse_m[9] < 0.3


def test_without_detection_and_without_truth_are_counted(root: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(root, tmp_path / "kitti"))
    masks = json.loads((copy / "masks" / "000001.json").read_text())
    (copy / "masks" / "000001.json").write_text(json.dumps([m for m in masks if m["instance_id"] == 1]))
    lines = (copy / "detections" / "data" / "000000.txt").read_text().splitlines()
    words = lines[2].split()
    elsewhere = " ".join([*words[:4], "0", "0", "5", "5", *words[8:11], "0", "1.65", "80", *words[14:]])
    (copy / "detections" / "data" / "000000.txt").write_text("\n".join([*lines[:2], elsewhere]) + "\n")
    scores = evaluate(copy, masks=copy / "masks")
    assert (scores.num_labels_counted, scores.num_without_truth, scores.num_without_detection) == (4, 1, 1)
    assert [(car.frame_id, car.label_line) for car in scores.cars] == [("000000", 1), ("000001", 2)]


def test_command(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ["--json", str(tmp_path / "s.json"), "--csv", str(tmp_path / "s.csv")]
    assert main(command(root, root / "perfect", *files)) == 0
    text = capsys.readouterr().out
    assert text.startswith("2 of 2 counted labels in 2 frames; 0 have no true surface, 0 no detection")
    assert "95 % intervals, bootstrap over cars" in text
    assert re.search(r"\ntau 0.05 m  2  .*  100.0 % \[100.0, 100.0\]", text)
    content = json.loads((tmp_path / "s.json").read_text())
    assert [curve["metric"] for curve in content["curves"]] == ["completeness", "accuracy", "f1", "rmse_m"]
    for curve in content["curves"]:
        assert len(curve["taus_m"]) == len(curve["summaries"]) == len(curve["num_cars"]) == 20
    with (tmp_path / "s.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 20
    assert float(rows[0]["completeness_after"]) > 0.99
    documented = (Path(__file__).parents[2] / "docs" / "file_formats.md").read_text(encoding="utf-8")
    documented = documented[documented.index("- **`evaluate-shape --json") :]
    assert content.pop("schema_version") == 1
    assert all(f"`{name}`" in documented for part in (content, content["curves"][0]) for name in part)
    assert all(f"`{re.sub('_(before|after)$', '', name)}`" in documented for name in rows[0])


def test_errors_name_what_is_wrong(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def fails(refined: Path, *extra: str) -> str:
        assert main(command(root, refined, *extra)) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        return captured.err

    assert "has no shapes/NNNNNN.npz" in fails(tmp_path)
    assert "frames: expected frames with ground truth, such as 000000, got 9" in fails(
        root / "perfect", "--frames", "9"
    )
    assert "000000.npz: cannot be read" in fails(tmp_path, "--frames", "000000")
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes" / "000000.npz").write_bytes(b"no archive")
    assert "000000.npz: is no readable npz file" in fails(tmp_path)
    assert "holds codes of another shape prior" in fails(root / "perfect", "--prior", "pca")
    assert "is not a folder of masks" in fails(root / "perfect", "--masks", str(tmp_path / "no"))
    empty = tmp_path / "empty"
    (empty / "training").mkdir(parents=True)
    assert "holds neither disp_occ_0 nor depth_2" in fails(root / "perfect", "--data", str(empty))
    assert "holds no folder 'training'" in fails(root / "perfect", "--data", str(tmp_path / "no"))


def test_library_errors(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one of the frames with ground truth, got none"):
        evaluate(root, frames=[])
    for frame_id in FRAMES:
        (tmp_path / f"{frame_id}.txt").write_text("")
    with pytest.raises(InputError, match="a counted label with a detection and a true surface, got none in 2 frames"):
        evaluate(root, labels_dir=tmp_path)


def test_a_frame_whose_map_of_depth_is_empty_has_no_true_surface(root: Path, tmp_path: Path) -> None:
    shutil.copytree(root, tmp_path / "root")
    shutil.rmtree(tmp_path / "root" / "training" / "disp_occ_0")
    both = evaluate(tmp_path / "root")
    empty = tmp_path / "root" / "training" / "depth_2" / f"{FRAMES[1]}.png"
    write_png(empty, np.zeros((120, 160), dtype=np.uint16))
    one = evaluate(tmp_path / "root")
    assert (one.num_frames, one.num_labels_counted) == (both.num_frames, both.num_labels_counted)
    assert one.num_without_truth == both.num_without_truth + len(both.cars) // 2
    write_png(empty, np.zeros((120, 160), dtype=np.uint8))
    with pytest.raises(DataFormatError, match=r"expected 16 bits \(metres times 256\), got uint8"):
        evaluate(tmp_path / "root")


def test_detections_of_another_run_are_named(root: Path, tmp_path: Path) -> None:
    for frame_id in FRAMES:
        first = (root / "detections" / "data" / f"{frame_id}.txt").read_text().splitlines()[0]
        (tmp_path / f"{frame_id}.txt").write_text(first + "\n")
    prior = load_prior(root / "prior.safetensors")
    with pytest.raises(DataFormatError, match="names line 3 of a detection file that has 1 lines"):
        evaluate_shapes(root, tmp_path, root / "perfect", prior, masks=root / "masks")


@pytest.mark.skipif("DIRECTSHAPE_DATA" not in os.environ, reason="DIRECTSHAPE_DATA is not set: frame 007322 needed")
def test_the_label_of_a_real_frame_beats_a_noisy_detection(tmp_path: Path) -> None:
    """A shape file with the label's pose and the mean shape: KITTI's truth must agree with KITTI's label."""
    data = Path(os.environ["DIRECTSHAPE_DATA"]) / "kitti"
    detections = data / "detections" / "noisy_stereo"
    words = ["refine", "--data", data, "--detections", detections, "--masks", data / "training" / "masks"]
    words += ["--frames", "007322", "--rig", "none", "--out", tmp_path, "--device", "cpu", "--threads", "1"]
    assert main([*map(str, words), "--set", "stages=[{max_iterations: 1}]"]) == 0
    path = tmp_path / "shapes" / "007322.npz"
    shapes = read_shapes(path)
    camera = to_stereo_camera(read_calibration(data / "training" / "calib" / "007322.txt"))
    labels = read_objects(data / "training" / "label_2" / "007322.txt")[:1]
    T_label = poses_cam(labels, camera.t_cam_ref[0]).numpy()
    write_shapes(path, dataclasses.replace(shapes, T_cam_obj=T_label, codes=np.zeros_like(shapes.codes)))
    masks = data / "training" / "masks"
    scores = evaluate_shapes(data, detections, tmp_path, load_prior("pca"), masks=masks)
    (car,) = scores.cars
    assert car.after.num_true == 13563
    assert car.after.f1[3] > 0.8
    assert car.before.f1[3] < 0.3
