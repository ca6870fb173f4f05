"""A tiny data set from images to files: results, resumption, and bad frames that touch no others."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.kitti_folder import CODE, FRAMES, PEDESTRIAN, write_data_set

from directshape_torch import compilation
from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.batch.options import RefineOptions, SilentObserver
from directshape_torch.batch.refine_dataset import expected_cars, refine_dataset, run_manifest
from directshape_torch.batch.run_record import RunRecord
from directshape_torch.batch.run_summary import RunSummary
from directshape_torch.config import RefinerConfig
from directshape_torch.config_files import load_config
from directshape_torch.errors import DirectShapeError, InputError, ResumeError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult
from directshape_torch.scene import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior

# The model of trust does not know toys that have not converged.
EVERY_RESULT = "acceptance.min_probability_not_worse=0"
FEW_STEPS = ("stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 2}]", EVERY_RESULT)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root)
    return root


@pytest.fixture
def root(source: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(source, tmp_path / "kitti"))


def refiner(root: Path, config: RefinerConfig | None = None) -> DirectShapeRefiner:
    return DirectShapeRefiner(PCAShapePrior.load(root / "prior.npz"), config or load_config(None, FEW_STEPS))


def dataset(root: Path, **options: Any) -> KittiStereoDataset:
    return KittiStereoDataset(root, root / "detections", root / "masks", **options)


def refine(root: Path, out: Path, *, config: RefinerConfig | None = None, **options: Any) -> RunSummary:
    return refine_dataset(dataset(root), refiner(root, config), out, RefineOptions(**options))


def files(folder: Path) -> dict[str, bytes]:
    """All files but those that tell of the run itself, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("timings.json", "run.json")
    }


def test_cars_come_nearer_to_the_truth(source: Path, tmp_path: Path) -> None:
    summary = refine(source, tmp_path, config=load_config(None, [EVERY_RESULT]))
    assert summary.exit_code == 0
    assert summary.num_cars == 2 * len(FRAMES)
    assert sum(summary.statuses.values()) == 2 * len(FRAMES)
    assert summary.statuses.get("no_mask", 0) == 0
    distances = []
    for frame_id in FRAMES:
        label, before, after = (
            [o for o in read_objects(folder / f"{frame_id}.txt") if o.type == "Car"]
            for folder in (source / "training" / "label_2", source / "detections" / "data", tmp_path / "data")
        )
        for true, first, last in zip(label, before, after, strict=True):
            distances.append([np.linalg.norm(np.subtract(o.location_ref, true.location_ref)) for o in (first, last)])
    before_m, after_m = np.mean(distances, axis=0)
    assert after_m < 0.5 * before_m


def test_lines_keep_their_order_and_other_classes_their_bytes(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path)
    lines = (tmp_path / "data" / "000000.txt").read_text().split("\n")
    given = (source / "detections" / "data" / "000000.txt").read_text().split("\n")
    assert len(lines) == len(given) == 4
    assert lines[1] == PEDESTRIAN
    for refined, rough in ((lines[0], given[0]), (lines[2], given[2])):
        assert refined != rough
        new, old = refined.split(), rough.split()
        assert new[:3] + new[4:8] + new[15:] == old[:3] + old[4:8] + old[15:]


def test_shapes_hold_states_of_the_refined_lines(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path)
    shapes = read_shapes(tmp_path / "shapes" / "000001.npz")
    assert shapes.input_lines.tolist() == [1, 3]
    assert shapes.codes.shape == np.shape(CODE)
    assert shapes.ground_source == "file"
    assert np.isfinite(shapes.covariances).all()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["sha256"]["prior"] == shapes.prior_sha256


def test_equal_runs_write_equal_bytes(source: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        refine(source, tmp_path / name, meshes="ply", overlays=True)
    first = files(tmp_path / "a")
    assert first == files(tmp_path / "b")
    assert {
        "data/000000.txt",
        "shapes/000000.npz",
        "meshes/000000_3.ply",
        "overlays/000000.png",
        "summary.json",
    } <= set(first)


def test_frames_in_one_call_give_the_results_of_single_calls(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path / "single")
    refine(source, tmp_path / "together", batch_frames=2)
    for frame_id in FRAMES:
        single, together = (
            read_shapes(tmp_path / name / "shapes" / f"{frame_id}.npz") for name in ("single", "together")
        )
        np.testing.assert_allclose(together.T_cam_obj, single.T_cam_obj, atol=2e-4)
        assert together.statuses == single.statuses
    calls = json.loads((tmp_path / "together" / "timings.json").read_text())["calls"]
    assert [call["frames"] for call in calls] == [["000000", "000001"], ["000002"]]


def test_a_second_run_does_nothing(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path)
    (tmp_path / "timings.json").unlink()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.txt")}
    summary = refine(source, tmp_path)
    assert summary.resumed == FRAMES
    assert summary.timings.calls == []
    assert not (tmp_path / "timings.json").exists()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.txt")} == before


def test_an_interrupted_run_continues_to_the_same_files(source: Path, tmp_path: Path) -> None:
    class Impatient:
        def started(self, frame_ids: Any) -> None:
            pass

        def finished(self, frame_id: str, failure: str | None) -> None:
            if frame_id == FRAMES[0]:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine_dataset(dataset(source), refiner(source), tmp_path / "a", observer=Impatient())
    assert not (tmp_path / "a" / "data" / f"{FRAMES[1]}.txt").exists()
    summary = refine(source, tmp_path / "a")
    assert summary.resumed == (FRAMES[0],)
    refine(source, tmp_path / "b")
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_further_outputs_are_added_to_finished_frames(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path)
    results = files(tmp_path / "data")
    assert refine(source, tmp_path, overlays=True).resumed == ()
    assert (tmp_path / "overlays" / "000000.png").is_file()
    assert files(tmp_path / "data") == results
    assert refine(source, tmp_path).resumed == FRAMES


@pytest.mark.parametrize("name", ["data/000001.txt", "shapes/000001.npz", "overlays/000001.png", "meshes/000001_1.ply"])
def test_outputs_that_were_removed_are_made_again(source: Path, tmp_path: Path, name: str) -> None:
    refine(source, tmp_path, overlays=True, meshes="ply")
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).unlink()
    assert refine(source, tmp_path, overlays=True, meshes="ply").resumed == ("000000", "000002")
    assert (tmp_path / name).read_bytes() == content


def test_removed_meshes_of_a_format_that_is_not_asked_for_stay_removed(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path, meshes="ply")
    refine(source, tmp_path, meshes="glb")
    entry = json.loads((tmp_path / "summary.json").read_text())["frames"]["000000"]
    assert entry["mesh_files"] == [f"meshes/000000_{line}.{kind}" for line in (1, 3) for kind in ("glb", "ply")]
    (tmp_path / "meshes" / "000000_3.ply").unlink()
    assert refine(source, tmp_path).resumed == refine(source, tmp_path, meshes="glb").resumed == FRAMES


def test_too_little_memory_says_what_to_do(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    too_big = refiner(source)
    monkeypatch.setattr(too_big, "forward", no_memory)
    summary = refine_dataset(dataset(source), too_big, tmp_path, RefineOptions(batch_frames=2))
    assert summary.exit_code == 1
    assert list(summary.failed) == list(FRAMES)
    assert "too little memory for 1 frame in a call (OutOfMemoryError: CUDA" in summary.failed["000002"]
    # Of three frames only the first two were ever refined together.
    assert any(warning.startswith("1 calls did not work with all of their frames") for warning in summary.warnings)


def test_a_call_that_does_not_fit_is_halved(source: Path, tmp_path: Path) -> None:
    class Small(DirectShapeRefiner):
        def forward(self, frames: FrameBatch, *args: Any) -> RefinementResult:
            if len(frames) > 1:
                raise RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory")
            return super().forward(frames, *args)

    small = Small(PCAShapePrior.load(source / "prior.npz"), load_config(None, FEW_STEPS))
    summary = refine_dataset(dataset(source), small, tmp_path / "halved", RefineOptions(batch_frames=3))
    assert summary.exit_code == 0
    # 3 = 2 + 1, and 2 = 1 + 1.
    assert any(warning.startswith("2 calls did not work with all of their frames") for warning in summary.warnings)
    refine(source, tmp_path / "single")
    assert files(tmp_path / "halved") == files(tmp_path / "single")


def test_an_unforeseen_error_fails_its_frame_alone(source: Path, tmp_path: Path) -> None:
    class Sensitive(DirectShapeRefiner):
        def forward(self, frames: FrameBatch, *args: Any) -> RefinementResult:
            if FRAMES[1] in frames.frame_ids:
                raise ZeroDivisionError("of this frame alone")
            return super().forward(frames, *args)

    sensitive = Sensitive(PCAShapePrior.load(source / "prior.npz"), load_config(None, FEW_STEPS))
    summary = refine_dataset(dataset(source), sensitive, tmp_path, RefineOptions(batch_frames=3))
    assert summary.failed == {FRAMES[1]: "ZeroDivisionError: of this frame alone"}


def test_another_setting_is_named_and_nothing_is_written(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path)
    before = files(tmp_path)
    with pytest.raises(ResumeError, match=r"refiner\.silhouette\.weight' was 12\.0, now is 6\.0"):
        refine(source, tmp_path, config=load_config(None, [*FEW_STEPS, "silhouette.weight=6"]))
    assert files(tmp_path) == before


def test_another_prior_or_input_is_named(root: Path, tmp_path: Path) -> None:
    refine(root, tmp_path / "out")
    prior = PCAShapePrior.load(root / "prior.npz")
    prior.mean += 0.001
    with pytest.raises(ResumeError, match="sha256 of 'prior'"):
        refine_dataset(dataset(root), DirectShapeRefiner(prior, load_config(None, FEW_STEPS)), tmp_path / "out")
    (root / "masks" / "000001.json").write_text("[]")
    with pytest.raises(ResumeError, match="frame 000001: sha256 of 'masks_0'"):
        refine(root, tmp_path / "out")
    (root / "masks" / "000001.json").unlink()
    with pytest.raises(ResumeError, match=r"000001 was refined from a file that is gone.*000001\.json"):
        refine(root, tmp_path / "out")


def test_results_without_a_summary_are_not_overwritten(source: Path, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "000000.txt").write_text("mine\n")
    with pytest.raises(ResumeError, match=r"summary\.json is missing"):
        refine(source, tmp_path)
    assert (tmp_path / "data" / "000000.txt").read_text() == "mine\n"


def test_detections_are_not_overwritten(root: Path) -> None:
    with pytest.raises(InputError, match="overwrite its own input"):
        refine(root, root / "detections")


def test_a_truncated_image_is_reported_and_the_others_go_on(root: Path, tmp_path: Path) -> None:
    refine(root, tmp_path / "whole")
    image = root / "training" / "image_3" / "000001.png"
    content = image.read_bytes()
    image.write_bytes(content[: len(content) // 2])
    summary = refine(root, tmp_path / "out")
    assert summary.exit_code == 1
    assert list(summary.failed) == ["000001"]
    assert "image_3/000001.png" in summary.failed["000001"]
    entry = json.loads((tmp_path / "out" / "summary.json").read_text())["frames"]["000001"]
    assert entry == {"state": "failed", "reason": summary.failed["000001"]}
    assert not (tmp_path / "out" / "data" / "000001.txt").exists()
    for name in ("data/000000.txt", "data/000002.txt", "shapes/000002.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    # Mended, the frame is tried again, and all is as if nothing had happened.
    image.write_bytes(content)
    assert refine(root, tmp_path / "out").resumed == ("000000", "000002")
    assert files(tmp_path / "out") == files(tmp_path / "whole")


def test_a_file_that_cannot_be_written_is_reported_and_the_others_go_on(source: Path, tmp_path: Path) -> None:
    (tmp_path / "data" / "000001.txt").mkdir(parents=True)
    (tmp_path / "summary.json").write_text(empty_summary(source, tmp_path / "elsewhere"))
    summary = refine(source, tmp_path)
    assert summary.exit_code == 1
    assert list(summary.failed) == ["000001"]
    assert "data/000001.txt" in summary.failed["000001"]
    assert (tmp_path / "data" / "000002.txt").is_file()


def empty_summary(source: Path, out: Path) -> str:
    """What a run leaves that was stopped before its first frame."""
    run = RunRecord(out, run_manifest(dataset(source), refiner(source), hash_prior(refiner(source).prior)))
    return run.path.read_text()


def test_a_full_disk_stops_the_run_and_the_next_goes_on(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    class Filler(SilentObserver):
        def finished(self, frame_id: str, failure: str | None) -> None:
            monkeypatch.setattr("directshape_torch.batch.group_refinement.write_frame_outputs", full)

    with pytest.raises(DirectShapeError, match=r"cannot write to .*No space left.*run the same command again"):
        refine_dataset(dataset(source), refiner(source), tmp_path, observer=Filler())
    monkeypatch.undo()
    summary = refine(source, tmp_path)
    assert (summary.resumed, summary.exit_code) == (FRAMES[:1], 0)


def test_a_line_of_14_columns_is_reported_with_its_text(root: Path, tmp_path: Path) -> None:
    path = root / "detections" / "data" / "000002.txt"
    path.write_text("Car 0 0 0 1 2 3 4 1.5 1.6 3.9 1 1.6 20\n")
    reason = refine(root, tmp_path / "out").failed["000002"]
    assert f"{path}, line 1" in reason
    assert "14" in reason
    (root / "training" / "label_2" / "000001.txt").write_text("Car 0 0 0 1 2 3 4 1.5 1.6 3.9 1 1.6 20\n")
    assert "label_2/000001.txt, line 1" in refine(root, tmp_path / "other").failed["000001"]


@pytest.mark.parametrize("content", ["", f"{PEDESTRIAN}\n"])
def test_a_frame_without_cars_is_copied(root: Path, tmp_path: Path, content: str) -> None:
    for frame_id in FRAMES:
        (root / "detections" / "data" / f"{frame_id}.txt").write_text(content)
    summary = refine(root, tmp_path, meshes="glb", overlays=True)
    assert summary.exit_code == 0
    assert summary.num_cars == 0
    assert (tmp_path / "data" / "000000.txt").read_text() == content
    assert read_shapes(tmp_path / "shapes" / "000000.npz").T_cam_obj.shape == (0, 4, 4)
    assert len(summary.warnings) == (1 if content else 0)


def test_cars_without_masks_stay_as_they_were_and_a_warning_says_so(root: Path, tmp_path: Path) -> None:
    for frame_id in FRAMES:
        (root / "masks" / f"{frame_id}.json").write_text("[]")
    summary = refine(root, tmp_path)
    assert summary.statuses == {"no_mask": 2 * len(FRAMES)}
    assert any("none of the 6 cars has a mask" in warning for warning in summary.warnings)
    name = "data/000000.txt"
    assert (tmp_path / name).read_bytes() == (root / "detections" / name).read_bytes()


def test_a_field_of_another_rig_fails_its_frames(source: Path, tmp_path: Path) -> None:
    camera = dataset(source).load("000000").frame.camera
    rig = DisparityField(
        coefficients=torch.zeros(10),
        hull_uv=torch.tensor([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]]),
        size_wh=(1242, 375),
        K_left=camera.K_left[0],
        K_right=camera.K_right[0],
        T_right_cam=camera.T_right_cam[0],
    )
    summary = refine_dataset(dataset(source, disparity_field=rig), refiner(source), tmp_path)
    assert list(summary.failed) == list(FRAMES)
    assert "1242" in summary.failed["000000"]
    assert not (tmp_path / "data").exists()


def test_a_long_run_compiles_from_its_first_frame_and_a_short_one_never(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert expected_cars(dataset(root), FRAMES) == 2 * len(FRAMES)
    assert expected_cars(dataset(root), FRAMES[:1] * 400) == 800
    (root / "detections" / "data" / "000002.txt").write_text("damaged")
    assert expected_cars(dataset(root), FRAMES) == 2 * (len(FRAMES) - 1)
    counts = []

    class Watched(DirectShapeRefiner):
        def forward(self, *args: Any, **kwargs: Any) -> RefinementResult:
            job = compilation._job.get()
            counts.append(None if job is None else job.cars_ahead)
            return super().forward(*args, **kwargs)

    monkeypatch.setattr("directshape_torch.batch.refine_dataset.expected_cars", lambda *_: 5000)
    # The number is what counts here; compiling for it would take minutes.
    watched = Watched(PCAShapePrior.load(root / "prior.npz"), load_config(None, [*FEW_STEPS, "compile=off"]))
    refine_dataset(dataset(root), watched, tmp_path)
    # The same for every call: neither the calls before nor an interruption change what is compiled.
    assert counts == [5000, 5000]
    assert compilation._job.get() is None


def test_options_are_checked() -> None:
    with pytest.raises(InputError, match="meshes: expected one of ply, glb"):
        RefineOptions(meshes="obj")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="batch_frames: expected at least 1, got 0"):
        RefineOptions(batch_frames=0)


def test_overlay_is_a_picture(source: Path, tmp_path: Path) -> None:
    refine(source, tmp_path, overlays=True)
    picture = cv2.imread(str(tmp_path / "overlays" / "000000.png"))
    assert picture is not None
    assert picture.shape[1] > 1000
