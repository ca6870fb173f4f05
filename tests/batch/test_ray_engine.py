"""A run on a cluster of Ray ends with the bytes of one process, whatever dies, and nodes that cannot work are named."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import quick_runs
from helpers.kitti_folder import SIX_FRAMES as FRAMES
from helpers.quick_runs import result_files
from helpers.slow_run import PATIENCE_S, environment, slow_run, wait_until

from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.ray_engine import RayEngine, check_cluster
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.io.run_folder import done_frames

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ends processes as Linux does")

refine = partial(quick_runs.refine, threads=1)


@pytest.fixture(scope="module")
def root(kitti_of_six: Path) -> Path:
    return kitti_of_six


@pytest.fixture(scope="module")
def expected(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, bytes]:
    out = tmp_path_factory.mktemp("one")
    refine(root, out)
    return result_files(out)


def free_port() -> int:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return int(held.getsockname()[1])


@contextmanager
def node(head: str | None = None, *before: Path, prefix: tuple[str, ...] = ()) -> Iterator[tuple[str, int]]:
    """A node of Ray with one processor, a new cluster if it is not told of a head; its address and its process.

    Ray's own processes end with the one that is started here, in whatever way that ends.
    """
    pytest.importorskip("ray", reason="the extra `cluster` is not installed")
    # The path of a socket may have a hundred letters.
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")
    command = [*prefix, sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start", "--block"]
    command += ["--node-ip-address", "127.0.0.1", "--num-cpus", "1", "--object-store-memory", "100000000"]
    command += ["--min-worker-port", "0", "--max-worker-port", "0", "--disable-usage-stats"]
    address = head
    if address is None:
        address = f"127.0.0.1:{free_port()}"
        command += ["--head", "--port", address.rpartition(":")[2]]
        command += ["--include-dashboard", "false", "--temp-dir", folder]
    else:
        command += ["--address", address]
    log = Path(folder) / "log"
    with log.open("wb") as file:
        process = subprocess.Popen(command, env=environment(*before), stdout=file, stderr=file, cwd=folder)
    try:
        wait_until(lambda: process.poll() is not None or b"ray stop" in log.read_bytes())
        assert process.poll() is None, log.read_text()
        yield address, process.pid
    finally:
        process.kill()
        process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def said(root: Path, out: Path, address: str) -> str:
    """The last line of a run that is refused before it has written anything."""
    with slow_run(root, out, address) as run:
        _, text = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1, text
    assert list(out.iterdir()) == []
    return text.strip().splitlines()[-1]


def test_a_node_that_is_killed_in_the_middle(root: Path, tmp_path: Path, expected: Mapping[str, bytes]) -> None:
    out = tmp_path / "out"
    with node() as (address, _), node(address) as (_, second), slow_run(root, out, address) as run:
        wait_until(lambda: run.poll() is not None or len(done_frames(out)) > 0)
        assert run.poll() is None, run.communicate()[1]
        os.kill(second, signal.SIGKILL)
        assert len(done_frames(out)) < len(FRAMES)
        assert run.wait(PATIENCE_S) == 0, run.communicate()[1]
    assert result_files(out) == expected


@pytest.mark.long
def test_a_driver_that_is_killed_and_started_anew(root: Path, tmp_path: Path, expected: Mapping[str, bytes]) -> None:
    out = tmp_path / "out"
    with node() as (address, _):
        with slow_run(root, out, address) as run:
            wait_until(lambda: run.poll() is not None or len(done_frames(out)) > 0)
            assert run.poll() is None, run.communicate()[1]
            run.kill()
        finished = len(done_frames(out))
        assert finished < len(FRAMES)
        with slow_run(root, out, address) as run:
            assert run.wait(PATIENCE_S) == 0, run.communicate()[1]
    # The run that was killed could not remove the file by which nodes recognise the folder.
    (mark,) = out.glob(".*.tmp")
    mark.unlink()
    assert result_files(out) == expected


OTHER_VERSION = """
import importlib.metadata
found = importlib.metadata.version
importlib.metadata.version = lambda name: "0.0.9" if name == "numpy" else found(name)
"""


def test_a_node_with_another_version(root: Path, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(OTHER_VERSION)
    (tmp_path / "out").mkdir()
    with node(None, tmp_path) as (address, _):
        text = said(root, tmp_path / "out", address)
    assert "InputError: ray: expected nodes that can do the job, got node " in text
    assert "numpy is 0.0.9 there and " in text


@pytest.mark.long
def test_a_node_without_the_package(root: Path, tmp_path: Path) -> None:
    (tmp_path / "directshape_torch").mkdir()
    (tmp_path / "directshape_torch" / "__init__.py").write_text("raise ModuleNotFoundError('it is not installed')")
    (tmp_path / "out").mkdir()
    with node(None, tmp_path) as (address, _):
        assert said(root, tmp_path / "out", address).endswith("ModuleNotFoundError: it is not installed")


@pytest.mark.long
@pytest.mark.parametrize("unseen", ["data", "out"])
def test_a_path_that_a_node_does_not_see(root: Path, tmp_path: Path, unseen: str) -> None:
    (tmp_path / "out").mkdir()
    hidden = root if unseen == "data" else tmp_path / "out"
    unshare = shutil.which("unshare")
    if unshare is None or os.geteuid() != 0:
        pytest.skip("only root can give a process other file systems")
    prefix = (unshare, "-m", "sh", "-c", f'mount -t tmpfs tmpfs {hidden} && exec "$@"', "sh")
    if subprocess.run([*prefix, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    with node(prefix=prefix) as (address, _):
        text = said(root, tmp_path / "out", address)
    assert "it does not see the files of the run: " in text
    assert str(hidden) in text


def test_an_address_that_does_not_answer(root: Path, tmp_path: Path) -> None:
    address = f"127.0.0.1:{free_port()}"
    with pytest.raises(InputError, match=rf"ray: expected the address of a running cluster, got {address} \("):
        refine(root, tmp_path, ray=address)
    for wrong in ("auto", "ray://127.0.0.1:10001", "127.0.0.1", "127.0.0.1:x"):
        with pytest.raises(InputError, match=r"ray: expected an address HOST:PORT, got"):
            refine(root, tmp_path, ray=wrong)
    assert list(tmp_path.iterdir()) == []


def test_a_graphics_card_is_none_of_ray() -> None:
    with pytest.raises(InputError, match="ray: expected a refiner on the CPU, got cuda"):
        check_cluster("127.0.0.1:6379", torch.device("cuda"))


def test_workers_are_those_of_the_nodes() -> None:
    with pytest.raises(InputError, match="workers: expected none with ray"):
        RefineOptions(workers=2, ray="127.0.0.1:6379")


def test_only_the_death_of_a_process_is_tried_again(tmp_path: Path) -> None:
    import ray

    engine = object.__new__(RayEngine)
    engine._ray, engine._mark = ray, tmp_path / "mark"
    died, broken = Future(), Future()  # type: ignore[var-annotated]
    died.set_exception(ray.exceptions.WorkerCrashedError())
    broken.set_exception(ray.exceptions.RaySystemError("no room"))
    assert engine.report(died) is None
    with pytest.raises(DirectShapeError, match="the cluster failed: System error: no room"):
        engine.report(broken)
