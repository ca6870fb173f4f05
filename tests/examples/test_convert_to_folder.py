"""The example converts the bundled frame from a rig of another user, and the result is read again."""

from __future__ import annotations

import json
import math
import runpy
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.bundled_frame import BOXES, DEMO, MASKS
from helpers.layouts import put

from directshape_torch.check.check_dataset import check_dataset
from directshape_torch.cli.main import main
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.io.kitti_labels import poses_cam
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset

EXAMPLE = Path(__file__).parents[2] / "examples" / "convert_to_folder.py"


def write_rig(demo: LoadedFrame, root: Path) -> None:
    """Write the frame in the forms of its detector and of OpenCV."""
    for side, folder in (("left", "image_2"), ("right", "image_3")):
        put(DEMO / "training" / folder / "000000.png", root / side / "street.png")
    camera = demo.frame.camera
    K_left, K_right, t = (
        np.asarray(part[0], dtype=float) for part in (camera.K_left, camera.K_right, camera.T_right_cam[:, :3, 3:])
    )
    file = cv2.FileStorage(str(root / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    file.write("P1", np.concatenate([K_left, np.zeros((3, 1))], axis=1))
    file.write("P2", np.concatenate([K_right, K_right @ t], axis=1))
    file.write("image_size", np.array([1242, 375]))
    file.release()
    origins = poses_cam(demo.input_objects, camera.t_cam_ref[0])[:, :3, 3].tolist()
    boxes: list[dict[str, Any]] = []
    for found, (x, y, z) in zip(demo.input_objects, origins, strict=True):
        height, width, length = found.hwl
        boxes.append(
            {
                "label": "car",
                "score": found.score,
                "center": [x, y - height / 2, z],
                "size_lwh": [length, width, height],
                "yaw": -math.pi / 2 - found.rotation_y,
            }
        )
    (root / "boxes.json").write_text(json.dumps({"street": boxes}))
    masks = json.loads((MASKS / "000000.json").read_text())
    for mask in masks:
        # Instances 1001 .. 1006 are the cars in the order of the detections.
        mask["box"] = mask["instance_id"] - 1001 if mask["instance_id"] <= 1006 else -1
    (root / "masks.json").write_text(json.dumps({"street": masks}))


@pytest.fixture(scope="module")
def kitti() -> LoadedFrame:
    return open_dataset("kitti", DEMO, BOXES, MASKS, dtype=torch.float64).load("000000")


@pytest.fixture(scope="module")
def folder(kitti: LoadedFrame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig, folder = tmp_path_factory.mktemp("rig"), tmp_path_factory.mktemp("folder")
    write_rig(kitti, rig)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(EXAMPLE), "--rig", str(rig), "--out", str(folder)])
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    return folder


def test_the_converted_folder_gives_the_same_frame(
    kitti: LoadedFrame, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = open_dataset("folder", folder, dtype=torch.float64).load("street")
    torch.testing.assert_close(loaded.detections.T_cam_obj, kitti.detections.T_cam_obj)
    torch.testing.assert_close(loaded.detections.mask_left.dense(), kitti.detections.mask_left.dense())
    torch.testing.assert_close(loaded.detections.mask_right.dense(), kitti.detections.mask_right.dense())
    torch.testing.assert_close(loaded.frame.camera.T_right_cam, kitti.frame.camera.T_right_cam)
    # 2D boxes that no file gives are those of the projected 3D boxes, which the detector's own are near.
    overlaps = box_iou(loaded.detections.box_2d.numpy(), kitti.detections.box_2d.numpy()).diagonal()
    assert overlaps.min() > 0.5
    assert main(["check-data", "--layout", "folder", "--data", str(folder)]) == 0
    assert "0 errors, 0 warnings, 0 notes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("forget", "check"),
    [
        (lambda entry: entry["bottom_center_m"].__setitem__(1, entry["bottom_center_m"][1] - 0.75), "box_origin"),
        (lambda entry: entry.update(rotation_y_rad=entry["rotation_y_rad"] + math.pi / 2), "box_yaw"),
        (lambda entry: entry["dimensions_hwl_m"].reverse(), "box_order"),
    ],
)
def test_a_conversion_that_was_forgotten_is_found(
    forget: Callable[[dict[str, Any]], None], check: str, folder: Path, tmp_path: Path
) -> None:
    """The folder gives no 2D boxes, so those made from the wrong 3D boxes must not speak for them: the masks do."""
    shutil.copytree(folder, tmp_path / "folder")
    path = tmp_path / "folder" / "frames" / "street.json"
    content = json.loads(path.read_text())
    for entry in content["objects"]:
        if "dimensions_hwl_m" in entry:
            forget(entry)
    path.write_text(json.dumps(content))
    report = check_dataset(open_dataset("folder", tmp_path / "folder"))
    assert [finding.check for finding in report.findings] == [check]
