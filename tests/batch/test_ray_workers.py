"""A run on a real Ray cluster of this machine, of which a worker is killed."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.faulty_refiners import DeadlyRefiner, QuickRefiner
from helpers.kitti_folder import write_data_set
from helpers.output_folders import result_files

import directshape_torch
from directshape_torch.batch.options import RefineOptions, WorkerOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_summary import RunSummary
from directshape_torch.errors import DirectShapeError, MissingDependencyError
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.refiner import DirectShapeRefiner

FRAMES = tuple(f"{number:06d}" for number in range(5))
# Ray's own threads and sockets, not ours.
pytestmark = pytest.mark.filterwarnings("default")


def refine(root: Path, out: Path, refiner: DirectShapeRefiner, who: WorkerOptions) -> RunSummary:
    dataset = KittiStereoDataset(root, root / "detections", root / "masks")
    return refine_dataset(dataset, refiner, out, RefineOptions("ply", batch_frames=2), workers=who)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, FRAMES)
    return root


@pytest.fixture(scope="module")
def _cluster() -> Iterator[None]:
    """One cluster for all tests: its start is what takes time."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ray = pytest.importorskip("ray")
        # Workers must find the helpers of the tests as well, and the package that this test has.
        folders = (Path(__file__).parent.parent, Path(directshape_torch.__file__).parent.parent)
        environment = {"env_vars": {"PYTHONPATH": os.pathsep.join(map(str, folders))}}
        ray.init(
            "local",
            num_cpus=2,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="error",
            runtime_env=environment,
        )
        yield
        ray.shutdown()


@pytest.mark.usefixtures("_cluster")
def test_a_cluster_of_which_a_worker_is_killed_writes_the_bytes_of_one_process(root: Path, tmp_path: Path) -> None:
    refine(root, tmp_path / "one", QuickRefiner(root), WorkerOptions(threads=1))
    deadly = DeadlyRefiner(root, tmp_path, once=[FRAMES[3]])
    summary = refine(root, tmp_path / "ray", deadly, WorkerOptions(workers=2, threads=1, ray="local"))
    assert (tmp_path / FRAMES[3]).exists(), "nobody was killed"
    assert summary.exit_code == 0
    assert result_files(tmp_path / "ray") == result_files(tmp_path / "one")
    assert sorted(call.frame_ids for call in summary.timings.calls) == [FRAMES[:2], FRAMES[2:4], FRAMES[4:]]
    assert summary.timings.workers == 2


@pytest.mark.usefixtures("_cluster")
def test_a_frame_that_kills_its_worker_fails_and_the_others_go_on(root: Path, tmp_path: Path) -> None:
    deadly = DeadlyRefiner(root, tmp_path, always=[FRAMES[4]])
    summary = refine(root, tmp_path / "out", deadly, WorkerOptions(ray="auto", retries=0))
    assert list(summary.failed) == [FRAMES[4]]
    assert "its worker died" in summary.failed[FRAMES[4]]
    assert len(list((tmp_path / "out" / "data").iterdir())) == len(FRAMES) - 1


def test_without_ray_the_error_says_what_to_install(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'directshape_torch\[ray\]'"):
        refine(root, tmp_path, QuickRefiner(root), WorkerOptions(ray="local"))


def test_an_address_where_nobody_answers(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class NoCluster:
        def is_initialized(self) -> bool:
            return False

        def init(self, **_: object) -> None:
            raise ConnectionError("nobody at 10.1.1.1:6379")

    monkeypatch.setattr("directshape_torch.batch.ray_workers._import_ray", NoCluster)
    with pytest.raises(DirectShapeError, match=r"no Ray cluster answers at '10.1.1.1:6379'"):
        refine(root, tmp_path, QuickRefiner(root), WorkerOptions(ray="10.1.1.1:6379"))
