"""Recordings for Rerun's viewer, read back by Rerun's own reader, hold the run, its inputs and its iterations."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
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

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import DataFormatError, MissingDependencyError
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.config_files import config_from_mapping
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.visualize.export_run import export_run
from directshape_torch.visualize.painted_cars import SEEN
from directshape_torch.visualize.run_frames import RunFrame

pytest.importorskip("rerun", reason="the extra `viewer` is not installed")

Place = tuple[int | None, int | None]


class Recording:
    """A `Recording` has all rows of an .rrd file: for each entity and component the values by (frame, iteration)."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(str(path))
        assert [entry.application_id for entry in reader.recordings()] == ["directshape"]
        assert len(reader.blueprints()) == 1
        self.rows: dict[tuple[str, str], dict[Place, Any]] = {}
        for chunk in reader.stream():
            batch = chunk.to_record_batch().to_pydict()
            for name in (name for name in batch if ":" in name):
                known = self.rows.setdefault((chunk.entity_path, name.split(":")[1]), {})
                for row, value in enumerate(batch[name]):
                    place = tuple(batch[line][row] if line in batch else None for line in ("frame", "iteration"))
                    known[place] = value  # type: ignore[index]

    def of(self, entity: str, component: str) -> Mapping[Place, Any]:
        return self.rows[entity, component]

    def at(self, entity: str, component: str, frame: int) -> Any:
        """The value of a frame, at any place on the other timeline."""
        (value,) = [value for place, value in self.of(entity, component).items() if place[0] == frame]
        return value

    def corners(self, entity: str, place: Place) -> NDArray[np.float64]:
        """Corners (B, 8, 3) of the boxes of an entity, each sorted."""
        parts = (self.of(entity, name)[place] for name in ("centers", "half_sizes", "quaternions"))
        centres, halves, quaternions = (np.array(part) for part in parts)
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        rotated = [Rotation.from_quat(q).apply(signs * half) for q, half in zip(quaternions, halves, strict=True)]
        return np.stack([by_place(c + box) for c, box in zip(centres, rotated, strict=True)])


def refiner_of(run: FinishedRun) -> DirectShapeRefiner:
    config = config_from_mapping(RefinerConfig, run.folder().setting("refiner"))
    return DirectShapeRefiner(PCAShapePrior.load(run.root / "prior.safetensors"), config)


@pytest.fixture(scope="module")
def path(finished: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "sub" / "recording.rrd"
    export_run(replace(finished.inputs(), refiner=refiner_of(finished)), path.parent, ["rerun"])
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


def test_frames_and_iterations_are_timelines(recording: Recording) -> None:
    assert set(recording.of("/world/cam/image", "blob")) == {(0, 0), (1, min(second_frame(recording)))}
    both = [recording.of(f"/terms/{frame}/1/height", "scalars") for frame in ("000000", "000001")]
    assert {place[0] for places in both for place in places} == {None}
    # The iterations of all frames follow one another.
    iterations = [place[1] for places in both for place in sorted(places)]
    assert iterations == list(range(len(iterations)))


def second_frame(recording: Recording) -> list[int]:
    """The iterations of the second frame, which begin at its images."""
    begin = max(place[1] or 0 for place in recording.of("/world/cam/image", "blob"))
    return [place[1] for place in recording.of("/terms/000001/1/height", "scalars") if place[1] >= begin]


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
    place = next(place for place in recording.of("/world/boxes/after", "centers") if place[0] == frame)
    name = f"{frame:06d}.txt"
    before = corners_of_lines(finished, finished.root / "detections" / "data" / name)
    np.testing.assert_allclose(recording.corners("/world/boxes/before", place), before, atol=2e-5)
    truth = corners_of_lines(finished, finished.root / "training" / "label_2" / name)
    np.testing.assert_allclose(recording.corners("/world/boxes/truth", place), truth, atol=2e-5)
    arrays = finished.state(f"{frame:06d}")
    names = ("location_ref", "rotation_y", "hwl")
    location, yaw, hwl = (torch.from_numpy(arrays[f"boxes_{name}"]).double() for name in names)
    after = box_corners(pose_from_kitti(location + t_cam_ref(finished), yaw), hwl).numpy()
    np.testing.assert_allclose(
        recording.corners("/world/boxes/after", place), np.stack([by_place(box) for box in after]), atol=2e-5
    )
    labels = [f"{line} {status}" for line, status in zip((1, 3), arrays["statuses"], strict=True)]
    assert recording.of("/world/boxes/after", "labels")[place] == labels


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


def test_iterations_begin_at_the_detection_and_end_at_the_result(finished: FinishedRun, recording: Recording) -> None:
    numbers = second_frame(recording)
    arrays = finished.state("000001")
    assert set(arrays["statuses"].tolist()) <= {"converged", "max_iterations"}
    last = recording.corners("/world/boxes/iteration", (None, max(numbers)))
    after = corners_of_lines(finished, finished.out / "data" / "000001.txt")
    np.testing.assert_allclose(last, after, atol=2e-3)
    # The first state is the mean shape where the detection is.
    first = np.array(recording.of("/world/boxes/iteration", "centers")[None, min(numbers)])
    detections = [one for one in read_objects(finished.root / "detections/data/000001.txt") if one.type == "Car"]
    wanted = np.array([one.location_ref for one in detections]) + t_cam_ref(finished).numpy()
    np.testing.assert_allclose(first[:, [0, 2]], wanted[:, [0, 2]], atol=2e-3)
    assert np.abs(first - np.array(recording.of("/world/boxes/iteration", "centers")[None, max(numbers)])).max() > 0.05


def test_costs_end_at_those_of_the_result_and_fall(finished: FinishedRun, recording: Recording) -> None:
    arrays, numbers = finished.state("000001"), second_frame(recording)
    for car, line in enumerate((1, 3)):
        series = {
            str(name): recording.of(f"/terms/000001/{line}/{str(name).replace(' ', '_')}", "scalars")
            for name in arrays["term_names"]
        }
        for place, costs in ((min(numbers), arrays["costs_before"]), (max(numbers), arrays["costs_after"])):
            got = [float(series[str(name)][None, place][0]) for name in arrays["term_names"]]
            np.testing.assert_allclose(got, costs[car], rtol=1e-3, atol=1e-5)
        totals = [sum(float(one[None, number][0]) for one in series.values()) for number in numbers]
        assert totals[-1] < 0.8 * totals[0]
        whole = [float(recording.of(f"/cost/000001/{line}", "scalars")[None, number][0]) for number in numbers]
        np.testing.assert_allclose(whole, totals)


def test_residuals_lie_on_their_cars_and_shrink(finished: FinishedRun, recording: Recording) -> None:
    loaded = finished.inputs().dataset.load("000001")  # type: ignore[union-attr]
    places = sorted(place for place in recording.of("/world/cam/image/silhouette/1", "positions") if place[0] is None)
    numbers = second_frame(recording)
    mine = [place for place in places if place[1] in numbers]
    assert len(mine) > 2
    points = np.array(recording.of("/world/cam/image/photometric/1", "positions")[mine[-1]]) - 0.5
    mask = cv2.dilate((loaded.detections.mask_left[0].numpy() > 0.5).astype(np.uint8), np.ones((9, 9)))
    column, row = np.rint(points).astype(int).T
    assert mask[row, column].mean() > 0.95
    # Black is no residual: the sum of the colours falls with the cost.
    first, last = (
        sum(colour >> 24 for colour in recording.of("/world/cam/image/silhouette/1", "colors")[place])
        for place in (mine[0], mine[-1])
    )
    assert last < first
    # The frame shows the end.
    final = next(place for place in recording.of("/world/cam/image/silhouette/1", "positions") if place[0] == 1)
    np.testing.assert_array_equal(
        recording.of("/world/cam/image/silhouette/1", "positions")[final],
        recording.of("/world/cam/image/silhouette/1", "positions")[mine[-1]],
    )


def test_without_a_refiner_there_are_frames_alone(finished: FinishedRun, tmp_path: Path) -> None:
    export_run(finished.inputs(has_detections=False), tmp_path, ["rerun"])
    recording = Recording(tmp_path / "recording.rrd")
    assert {place[1] for places in recording.rows.values() for place in places} == {None}
    assert {place[0] for place in recording.of("/world/cam/image", "blob")} == {0, 1}
    assert not any(entity.startswith("/terms/") for entity, _ in recording.rows)
    # Nobody said which boxes went in.
    assert recording.of("/world/boxes/before", "centers")[0, None] == []


def test_a_car_moves_under_the_name_of_its_track(finished: FinishedRun, tmp_path: Path) -> None:
    run = finished.with_tracks(tmp_path / "run", ("000007", ""), [(0, -1), (0, -1)])
    export_run(finished.inputs(run), tmp_path, ["rerun"])
    recording = Recording(tmp_path / "recording.rrd")
    assert {place[0] for place in recording.of("/world/cars/track_000007", "vertex_positions")} == {0, 1}


def test_a_damaged_image_leaves_no_file(finished: FinishedRun, tmp_path: Path) -> None:
    root = Path(shutil.copytree(finished.root, tmp_path / "kitti"))
    (root / "training" / "image_2" / "000001.png").write_bytes(b"no image")
    dataset = open_dataset("kitti", root, root / "detections", root / "masks")
    with pytest.raises(DataFormatError, match="000001"):
        export_run(replace(finished.inputs(), dataset=dataset), tmp_path / "out", ["rerun"])
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("recording_first", [True, False])
def test_an_end_that_fails_leaves_nothing_half_written(
    finished: FinishedRun, tmp_path: Path, recording_first: bool
) -> None:
    run, out = finished.with_tracks(tmp_path / "run", ("000007", ""), [(0, -1), (0, -1)]), tmp_path / "out"
    (out / "glb" / "track_000007.glb").mkdir(parents=True)
    formats = ["rerun", "glb"] if recording_first else ["glb", "rerun"]
    with pytest.raises(OSError, match=r"track_000007\.glb"):
        export_run(finished.inputs(run), out, formats)
    assert {path.name for path in out.iterdir()} == ({"glb"} if recording_first else {"glb", "recording.rrd"})


def test_without_rerun_the_error_says_what_to_install(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'directshape_torch\[viewer\]'"):
        export_run(finished.inputs(), tmp_path, ["rerun"])
