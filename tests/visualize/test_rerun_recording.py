"""Recordings for Rerun's viewer, read back by Rerun's own reader, hold the run and its inputs."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.finished_run import FinishedRun, by_place
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from directshape_torch.errors import DataFormatError, MissingDependencyError
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.visualize.export_run import export_run
from directshape_torch.visualize.painted_cars import SEEN
from directshape_torch.visualize.run_frames import RunFrame

pytest.importorskip("rerun", reason="the extra `viewer` is not installed")


class Recording:
    """A `Recording` has all rows of an .rrd file: for each entity and component the values by frame."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(str(path))
        assert [entry.application_id for entry in reader.recordings()] == ["directshape"]
        assert len(reader.blueprints()) == 1
        self.rows: dict[tuple[str, str], dict[int | None, Any]] = {}
        for chunk in reader.stream():
            batch = chunk.to_record_batch().to_pydict()
            for name in (name for name in batch if ":" in name):
                known = self.rows.setdefault((chunk.entity_path, name.split(":")[1]), {})
                for row, value in enumerate(batch[name]):
                    known[batch["frame"][row] if "frame" in batch else None] = value

    def at(self, entity: str, component: str, frame: int) -> Any:
        return self.rows[entity, component][frame]

    def corners(self, entity: str, frame: int) -> NDArray[np.float64]:
        """Corners (B, 8, 3) of the boxes of an entity, each sorted."""
        parts = (self.at(entity, name, frame) for name in ("centers", "half_sizes", "quaternions"))
        centres, halves, quaternions = (np.array(part) for part in parts)
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        rotated = [Rotation.from_quat(q).apply(signs * half) for q, half in zip(quaternions, halves, strict=True)]
        return np.stack([by_place(c + box) for c, box in zip(centres, rotated, strict=True)])


@pytest.fixture(scope="module")
def path(finished: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "sub" / "recording.rrd"
    export_run(finished.inputs(), path.parent, ["rerun"])
    assert [file.name for file in path.parent.iterdir()] == ["recording.rrd"]
    return path


@pytest.fixture(scope="module")
def recording(path: Path) -> Recording:
    return Recording(path)


def t_cam_ref(run: FinishedRun) -> torch.Tensor:
    return run.inputs().dataset.load("000000").frame.camera.t_cam_ref[0].double()  # type: ignore[union-attr]


def corners_of_lines(run: FinishedRun, path: Path) -> NDArray[np.float64]:
    """Corners of the cars of a KITTI file in the left camera, by this package's own formula."""
    cars = [one for one in read_objects(path) if one.type == "Car"]
    location = torch.tensor([one.location_ref for one in cars]).double() + t_cam_ref(run)
    T = pose_from_kitti(location, torch.tensor([one.rotation_y for one in cars]).double())
    corners = box_corners(T, torch.tensor([one.hwl for one in cars]).double())
    return np.stack([by_place(box) for box in corners.numpy()])


@pytest.mark.parametrize(("entity", "folder"), [("/world/cam/image", "image_2"), ("/right/image", "image_3")])
def test_images_are_those_of_the_data_set(
    finished: FinishedRun, recording: Recording, entity: str, folder: str
) -> None:
    content = np.array(recording.at(entity, "blob", 1)[0], dtype=np.uint8)
    image = cv2.imdecode(content, cv2.IMREAD_COLOR).astype(float)
    wanted = cv2.imread(str(finished.root / f"training/{folder}/000001.png")).astype(float)
    assert np.abs(image - wanted).mean() < 3
    assert recording.at(entity, "media_type", 1) == ["image/jpeg"]


def test_masks_have_the_numbers_of_lines(finished: FinishedRun, recording: Recording) -> None:
    loaded = finished.inputs().dataset.load("000000")  # type: ignore[union-attr]
    for entity, masks in (
        ("/world/cam/image/masks", loaded.detections.mask_left.dense()),
        ("/right/image/masks", loaded.detections.mask_right.dense()),
    ):
        content = np.array(recording.at(entity, "buffer", 0)[0], dtype=np.uint8).view("<u2").reshape(120, 160)
        assert recording.at(entity, "format", 0)[0]["width"] == 160
        for line, mask in zip((1, 3), masks.numpy() > 0.5, strict=True):
            np.testing.assert_array_equal(content == line, mask)


def test_the_camera_is_the_calibrations_with_pixels_from_their_corners(
    finished: FinishedRun, recording: Recording
) -> None:
    K = np.array(recording.at("/world/cam", "image_from_camera", 0)[0]).reshape(3, 3).T
    np.testing.assert_allclose(K, finished.P_left("000000")[:, :3] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], rtol=1e-6)


@pytest.mark.parametrize("frame", [0, 1])
def test_boxes_are_those_of_the_files(finished: FinishedRun, recording: Recording, frame: int) -> None:
    name = f"{frame:06d}.txt"
    before = corners_of_lines(finished, finished.root / "detections" / "data" / name)
    np.testing.assert_allclose(recording.corners("/world/boxes/before", frame), before, atol=2e-5)
    truth = corners_of_lines(finished, finished.root / "training" / "label_2" / name)
    np.testing.assert_allclose(recording.corners("/world/boxes/truth", frame), truth, atol=2e-5)
    arrays = finished.state(f"{frame:06d}")
    names = ("location_ref", "rotation_y", "hwl")
    location, yaw, hwl = (torch.from_numpy(arrays[f"boxes_{name}"]).double() for name in names)
    after = box_corners(pose_from_kitti(location + t_cam_ref(finished), yaw), hwl).numpy()
    np.testing.assert_allclose(
        recording.corners("/world/boxes/after", frame), np.stack([by_place(box) for box in after]), atol=2e-5
    )
    labels = [f"{line} {status}" for line, status in zip((1, 3), arrays["statuses"], strict=True)]
    assert recording.at("/world/boxes/after", "labels", frame) == labels


def test_frames_show_the_refined_surfaces_with_the_colours_of_the_image(
    finished: FinishedRun, recording: Recording
) -> None:
    painted = RunFrame(finished.inputs(), "000001").painted
    for index, car in enumerate(painted.cars):
        mesh, paint = painted.mesh(index)
        entity = f"/world/cars/{car.line}"
        np.testing.assert_allclose(recording.at(entity, "vertex_positions", 1), mesh.vertices, atol=1e-5)
        np.testing.assert_array_equal(recording.at(entity, "triangle_indices", 1), mesh.faces)
        packed = np.array(recording.at(entity, "vertex_colors", 1), dtype=np.uint32)
        rgb = np.stack([packed >> shift & 255 for shift in (24, 16, 8)], axis=1)
        np.testing.assert_array_equal(rgb, paint.rgb)
        assert (paint.source == SEEN).any()


def test_without_detections_there_are_no_boxes_before(finished: FinishedRun, tmp_path: Path) -> None:
    export_run(finished.inputs(has_detections=False), tmp_path, ["rerun"])
    recording = Recording(tmp_path / "recording.rrd")
    assert set(recording.rows["/world/cam/image", "blob"]) == {0, 1}
    assert recording.at("/world/boxes/before", "centers", 0) == []


def test_a_car_moves_under_the_name_of_its_track(finished: FinishedRun, tmp_path: Path) -> None:
    run = finished.with_tracks(tmp_path / "run", ("000007", ""), [(0, -1), (0, -1)])
    export_run(finished.inputs(run), tmp_path, ["rerun"])
    recording = Recording(tmp_path / "recording.rrd")
    assert set(recording.rows["/world/cars/track_000007", "vertex_positions"]) == {0, 1}


def test_a_damaged_image_leaves_no_file(finished: FinishedRun, tmp_path: Path) -> None:
    root = Path(shutil.copytree(finished.root, tmp_path / "kitti"))
    (root / "training" / "image_2" / "000001.png").write_bytes(b"no image")
    dataset = open_dataset("kitti", root, root / "detections", root / "masks")
    with pytest.raises(DataFormatError, match="000001"):
        export_run(replace(finished.inputs(), dataset=dataset), tmp_path / "out", ["rerun"])
    assert list((tmp_path / "out").iterdir()) == []


def test_without_rerun_the_error_says_what_to_install(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'directshape_torch\[viewer\]'"):
        export_run(finished.inputs(), tmp_path, ["rerun"])
