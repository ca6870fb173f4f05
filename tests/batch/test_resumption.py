"""A second run into a folder repeats what is missing, keeps what is finished and refuses other inputs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from helpers.kitti_folder import FRAMES
from helpers.quick_runs import FEW_STEPS, refine, result_files

from directshape_torch.batch.resumption import join_summary
from directshape_torch.errors import ResumeError
from directshape_torch.io.config_files import load_config
from directshape_torch.io.run_folder import summary_path
from directshape_torch.io.run_manifest import RunManifest, read_manifest
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.visualize.overlay import overlay_of_frame


def test_a_second_run_does_nothing(shared_kitti: Path, tmp_path: Path) -> None:
    refine(shared_kitti, tmp_path)
    (tmp_path / "timings.json").unlink()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.txt")}
    summary = refine(shared_kitti, tmp_path)
    assert summary.resumed == FRAMES
    assert summary.timings.calls == []
    assert not (tmp_path / "timings.json").exists()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.txt")} == before


def test_further_outputs_are_added_to_finished_frames(shared_kitti: Path, tmp_path: Path) -> None:
    refine(shared_kitti, tmp_path)
    results = result_files(tmp_path / "data")
    assert refine(shared_kitti, tmp_path, draw=overlay_of_frame).resumed == ()
    assert (tmp_path / "overlays" / "000000.png").is_file()
    assert result_files(tmp_path / "data") == results
    assert refine(shared_kitti, tmp_path).resumed == FRAMES


def test_outputs_that_were_removed_are_made_again(shared_kitti: Path, tmp_path: Path) -> None:
    refine(shared_kitti, tmp_path, draw=overlay_of_frame)
    before = result_files(tmp_path)
    for name in ("data/000001.txt", "shapes/000001.npz", "overlays/000001.png"):
        (tmp_path / name).unlink()
        assert refine(shared_kitti, tmp_path, draw=overlay_of_frame).resumed == ("000000", "000002")
        assert result_files(tmp_path) == before


def test_another_prior_or_input_is_named(kitti_copy: Path, tmp_path: Path) -> None:
    refine(kitti_copy, tmp_path / "out")
    before = result_files(tmp_path / "out")
    prior = PCAShapePrior.load(kitti_copy / "prior.safetensors")
    prior.mean += 0.001
    with pytest.raises(ResumeError, match="sha256 of 'prior'"):
        refine(kitti_copy, tmp_path / "out", DirectShapeRefiner(prior, load_config(None, FEW_STEPS)))
    (kitti_copy / "masks" / "000001.json").write_text("[]")
    with pytest.raises(ResumeError, match="frame 000001: sha256 of 'masks_0'"):
        refine(kitti_copy, tmp_path / "out")
    (kitti_copy / "masks" / "000001.json").unlink()
    with pytest.raises(ResumeError, match=r"000001 was refined from a file that is gone.*000001\.json"):
        refine(kitti_copy, tmp_path / "out")
    assert result_files(tmp_path / "out") == before


def test_results_without_a_summary_are_not_overwritten(shared_kitti: Path, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "000000.txt").write_text("mine\n")
    with pytest.raises(
        ResumeError, match=r"summary\.json is missing.*; choose another output folder, or remove this one$"
    ):
        refine(shared_kitti, tmp_path)
    assert (tmp_path / "data" / "000000.txt").read_text() == "mine\n"


def test_runs_that_begin_together_are_all_in_the_summary(tmp_path: Path) -> None:
    manifests = [RunManifest("0", {}, {"prior": "a", "stereo_bias": None}, [f"{n:06d}"]) for n in range(8)]
    with ThreadPoolExecutor(len(manifests)) as threads:
        list(threads.map(lambda manifest: join_summary(tmp_path, manifest), manifests))
    written = read_manifest(summary_path(tmp_path))
    assert written is not None
    assert written.frames == [f"{n:06d}" for n in range(8)]
