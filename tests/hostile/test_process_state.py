"""What belongs to the whole process is afterwards as it was before, whatever was called, also when it failed."""

from __future__ import annotations

import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.quick_runs import dataset, refiner
from helpers.synthetic_scene import cached_street

from directshape_torch import DirectShapeRefiner, load_config
from directshape_torch.batch.options import RefineOptions, WorkerOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.cli.main import main
from directshape_torch.errors import DirectShapeError
from directshape_torch.files.atomic_files import write_json
from directshape_torch.shape.load_prior import load_prior


def state() -> dict[str, Any]:
    tf32 = [torch._C._get_fp32_precision_getter(backend, "matmul") for backend in ("cuda", "mkldnn")]
    return {
        "umask": next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("Umask")),
        "threads": (torch.get_num_threads(), torch.get_num_interop_threads(), cv2.getNumThreads()),
        "living": threading.active_count(),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)],
        "environment": dict(os.environ),
        "folder": os.getcwd(),
        "imports": list(sys.path),
        "recursion": sys.getrecursionlimit(),
        "warnings": list(warnings.filters),
        "random": (torch.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()),  # noqa: NPY002
        "torch": (torch.get_default_dtype(), torch.is_grad_enabled(), torch.are_deterministic_algorithms_enabled()),
        "digits": (torch.get_float32_matmul_precision(), tf32, torch.is_autocast_enabled("cpu")),
        "numpy": np.geterr(),
        "files": sorted(os.listdir("/proc/self/fd")),
    }


def forward(_: Path, __: Path) -> None:
    prior, street = cached_street()
    config = load_config(None, ["stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 1}]"])
    DirectShapeRefiner(prior, config)(street.frames, street.detections)


def run(root: Path, out: Path) -> None:
    options = RefineOptions("ply", overlays=True)
    one = dataset(root, frames=["000000"])
    refine_dataset(one, refiner(root), out / "out", options, workers=WorkerOptions(threads=2))


def data_options(root: Path) -> list[str]:
    return ["--data", str(root), "--detections", str(root / "detections"), "--masks", str(root / "masks")]


def refine_command(root: Path, out: Path) -> None:
    prior = ["--prior", str(root / "prior.npz"), "--set", "solver.max_code=2"]
    main(["refine", *data_options(root), "--out", str(out / "out"), *prior, "--frames", "000000"])


def failing_command(root: Path, out: Path) -> None:
    assert main(["refine", *data_options(root), "--out", str(out / "out"), "--prior", str(out)]) == 2


def failing_run(root: Path, _: Path) -> None:
    with pytest.raises(DirectShapeError):
        refine_dataset(dataset(root), refiner(root), root / "detections", workers=WorkerOptions(threads=2))


def priors(_: Path, out: Path) -> None:
    for name in ("pca", "neural"):
        prior = load_prior(name)
        path = out / ("a.npz" if name == "pca" else "a.safetensors")
        prior.save(path)  # type: ignore[attr-defined]
        load_prior(path)


def check_data(root: Path, _: Path) -> None:
    main(["check-data", *data_options(root), "--frames", "000000"])


def write(_: Path, out: Path) -> None:
    write_json(out / "a.json", {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(out / "a.json", float("nan"))


CALLS = (forward, run, refine_command, failing_command, failing_run, priors, check_data, write)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks /proc")
@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.__name__)
def test_what_belongs_to_the_process(
    shared_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[[Path, Path], None]
) -> None:
    def touched(_: int) -> int:
        raise AssertionError("the umask was set, for a moment at least")

    monkeypatch.setattr(os, "umask", touched)
    before = state()
    call(shared_kitti, tmp_path)
    after = state()
    # Packages that are imported on the way put some before them.
    after["warnings"] = after["warnings"][-len(before["warnings"]) :]
    assert {name: value for name, value in after.items() if before[name] != value} == {}
