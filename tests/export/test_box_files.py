"""KITTI, COCO-3D and nuScenes files, read back by other libraries, hold the boxes of the run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.finished_run import FRAMES, FinishedRun, by_place
from numpy.typing import NDArray

from directshape_torch.export.export_run import export_run
from directshape_torch.export.frame_source import ExportOptions
from directshape_torch.geometry.box3d import box_corners

CARS_AND_PEDESTRIAN = 3


@pytest.fixture(scope="module")
def exported(finished: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boxes")
    export_run(finished.inputs(), folder, ["kitti", "coco3d", "nuscenes"], ExportOptions(finished.root))
    return folder


def corners_ref(run: FinishedRun, frame_id: str, car: int) -> NDArray[np.float64]:
    """Corners from the state and size in the npz file by this package's own formula, sorted."""
    state = run.state(frame_id)
    T = torch.from_numpy(state["T_ref_obj"][car].astype(np.float64)).clone()
    T[:3, 3] = torch.from_numpy(state["boxes_location_ref"][car].astype(np.float64))
    return by_place(box_corners(T, torch.from_numpy(state["boxes_hwl"][car].astype(np.float64))).numpy())


def test_kitti_text_is_copied_byte_for_byte(finished: FinishedRun, exported: Path) -> None:
    for frame_id in FRAMES:
        name = f"data/{frame_id}.txt"
        assert (exported / "kitti" / name).read_bytes() == (finished.out / name).read_bytes()


def test_kitti_json_says_what_the_lines_and_the_npz_say(finished: FinishedRun, exported: Path) -> None:
    content = json.loads((exported / "kitti" / "json" / "000001.json").read_text())
    state = finished.state("000001")
    lines = (finished.out / "data" / "000001.txt").read_text().splitlines()
    assert [one["status"] for one in content["objects"]] == [state["statuses"][0], "copied", state["statuses"][1]]
    for one, line in zip(content["objects"], lines, strict=True):
        words = line.split()
        columns = [one["truncated"], one["occluded"], one["alpha"], *one["bbox"], *one["dimensions_hwl"]]
        columns += [*one["location"], one["rotation_y"], one["score"]]
        assert one["type"] == words[0]
        assert columns == [float(word) for word in words[1:]]
    first = content["objects"][0]
    np.testing.assert_allclose(first["sigma_xyz_yaw"], state["sigmas_ref"][0])
    np.testing.assert_allclose(first["code"], state["codes"][0])
    for name in ("better", "not_worse"):
        np.testing.assert_allclose(first[f"probability_{name}"], state[f"probabilities_{name}"][0])
    np.testing.assert_allclose(first["location"], state["boxes_location_ref"][0], atol=1e-4)


def test_pycocotools_loads_the_coco_file(exported: Path) -> None:
    from pycocotools.coco import COCO

    coco = COCO(str(exported / "coco3d.json"))
    assert coco.getImgIds() == [0, 1]
    cars = coco.getAnnIds(imgIds=[1], catIds=coco.getCatIds(catNms=["car"]))
    assert [one["line"] for one in coco.loadAnns(cars)] == [1, 3]
    assert len(coco.getAnnIds(imgIds=[1])) == CARS_AND_PEDESTRIAN
    image = coco.loadImgs([1])[0]
    assert (image["width"], image["height"], image["file_path"]) == (160, 120, "training/image_2/000001.png")
    line = (exported / "kitti" / "data" / "000001.txt").read_text().splitlines()[0].split()
    u_min, v_min, u_max, v_max = (float(word) for word in line[4:8])
    np.testing.assert_allclose(coco.loadAnns(cars)[0]["bbox"], [u_min, v_min, u_max - u_min, v_max - v_min])


def test_coco_boxes_are_those_of_the_run_in_the_left_camera(finished: FinishedRun, exported: Path) -> None:
    content = json.loads((exported / "coco3d.json").read_text())
    K, fourth = np.split(finished.P_left("000001"), [3], axis=1)
    np.testing.assert_allclose(content["images"][1]["K"], K, rtol=1e-6)
    for annotation in content["annotations"]:
        if annotation["category_name"] != "car":
            continue
        frame_id = f"{annotation['image_id']:06d}"
        wanted = corners_ref(finished, frame_id, [1, 3].index(annotation["line"])) + np.linalg.solve(K, fourth)[:, 0]
        width, height, length = annotation["dimensions"]
        # As Omni3D's own tools build a box: length along x, height along y, width along z.
        signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1).T
        built = signs * [length, height, width] @ np.array(annotation["R_cam"]).T + annotation["center_cam"]
        np.testing.assert_allclose(by_place(built), wanted, atol=2e-5)
        listed = np.array(annotation["bbox3D_cam"])
        np.testing.assert_allclose(by_place(listed), wanted, atol=2e-5)
        # The first corner is that of -x, -y, -z of the object; its neighbours differ in one of them each.
        edges = [np.linalg.norm(listed[k] - listed[0]) for k in (1, 3, 4)]
        np.testing.assert_allclose(edges, [length, height, width], atol=1e-9)
        uv = wanted @ K.T
        uv = uv[:, :2] / uv[:, 2:]
        np.testing.assert_allclose(annotation["bbox2D_proj"], [*uv.min(0), *uv.max(0)], atol=1e-2)
        cut = np.clip(annotation["bbox2D_proj"], 0, [159, 119, 159, 119])
        np.testing.assert_allclose(annotation["bbox2D_trunc"], cut)


def test_pyquaternion_builds_the_nuscenes_boxes(finished: FinishedRun, exported: Path) -> None:
    """As nuScenes' devkit does: length along x, width along y, height along z, turned by the quaternion."""
    from pyquaternion import Quaternion

    content = json.loads((exported / "nuscenes.json").read_text())
    assert set(content["results"]) == set(FRAMES)
    for frame_id, boxes in content["results"].items():
        assert len(boxes) == CARS_AND_PEDESTRIAN
        names = [box["detection_name"] for box in boxes]
        assert sorted(names) == ["car", "car", "pedestrian"]
        scores = [box["detection_score"] for box in boxes]
        assert scores == sorted(scores, reverse=True)
        for box in boxes:
            assert box["sample_token"] == frame_id
            if box["detection_name"] != "car":
                continue
            rotation = Quaternion(box["rotation"])
            assert abs(rotation.norm - 1) < 1e-12
            w, long, h = box["size"]
            x, y, z = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1)
            corners = (
                rotation.rotation_matrix @ np.stack([long * x, w * y, h * z]) + np.array(box["translation"])[:, None]
            )
            # Forward, left, up of the vehicle are z, -x, -y of the label's frame.
            in_ref = np.stack([-corners[1], -corners[2], corners[0]], axis=1)
            wanted = corners_ref(finished, frame_id, 0 if box["detection_score"] == scores[0] else 1)
            np.testing.assert_allclose(by_place(in_ref), wanted, atol=2e-5)


def test_nuscenes_heading_is_the_cars_own(finished: FinishedRun, exported: Path) -> None:
    """The box's x axis points where the car drives; nuScenes' yaw is minus rotation_y minus a quarter turn."""
    from pyquaternion import Quaternion

    boxes = json.loads((exported / "nuscenes.json").read_text())["results"]["000000"]
    state = finished.state("000000")
    for car, box in enumerate(box for box in boxes if box["detection_name"] == "car"):
        forward = Quaternion(box["rotation"]).rotate([1.0, 0.0, 0.0])
        yaw = -float(state["boxes_rotation_y"][car]) - np.pi / 2
        np.testing.assert_allclose(np.arctan2(forward[1], forward[0]), np.angle(np.exp(1j * yaw)), atol=1e-5)


def test_boxes_alone_need_no_images(finished: FinishedRun, exported: Path, tmp_path: Path) -> None:
    export_run(finished.inputs(with_images=False), tmp_path, ["nuscenes", "kitti"])
    assert (tmp_path / "nuscenes.json").read_bytes() == (exported / "nuscenes.json").read_bytes()
