"""The state of the process is the same before and after every call, also after a failure."""

from __future__ import annotations

import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.quick_runs import EVERY_RESULT, dataset, refiner
from helpers.synthetic_scene import cached_street

from directshape_torch import DirectShapeRefiner, RigEstimate, check_scene, fit_shape, load_config
from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.cli.main import main
from directshape_torch.errors import DirectShapeError
from directshape_torch.files.atomic_files import write_json
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.visualize.overlay import overlay_of_frame


def state() -> dict[str, Any]:
    tf32 = [products.fp32_precision for products in (torch.backends.cuda.matmul, torch.backends.mkldnn.matmul)]
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
        "files": open_files(),
    }


def open_files() -> list[str]:
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    return sorted(str(link.readlink()) for link in links)


ONE_STEP = "stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 1}]"


def forward(_: Path, __: Path) -> None:
    prior, street = cached_street()
    config = load_config(None, [ONE_STEP])
    DirectShapeRefiner(prior, config)(street.frames, street.detections)


def run(root: Path, out: Path) -> None:
    options = RefineOptions(draw=overlay_of_frame, threads=2)
    one = dataset(root, frames=["000000"])
    refine_dataset(one, refiner(root), out / "out", options)


def data_options(root: Path) -> list[str]:
    return ["--data", str(root), "--detections", str(root / "detections"), "--masks", str(root / "masks")]


def failing_command(root: Path, out: Path) -> None:
    assert main(["refine", *data_options(root), "--out", str(out / "out"), "--prior", str(out)]) == 2


def failing_run(root: Path, _: Path) -> None:
    with pytest.raises(DirectShapeError):
        refine_dataset(dataset(root), refiner(root), root / "detections", RefineOptions(threads=2))


def priors(_: Path, out: Path) -> None:
    for name in ("pca", "neural"):
        prior = load_prior(name)
        path = out / ("a.npz" if name == "pca" else "a.safetensors")
        prior.save(path)  # type: ignore[attr-defined]
        load_prior(path)


def write(_: Path, out: Path) -> None:
    write_json(out / "a.json", {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(out / "a.json", float("nan"))


def gradient(_: Path, __: Path) -> None:
    prior, street = cached_street()
    masks = street.detections.mask_left.dense().double().clone().requires_grad_()
    config = load_config("fast", ["backward.mode=unroll", *EVERY_RESULT])
    result = DirectShapeRefiner(prior, config)(street.frames, replace(street.detections, mask_left=masks))
    result.T_cam_obj.sum().backward()


def tensors(_: Path, __: Path) -> None:
    frames, detections = cached_street()[1].frames, cached_street()[1].detections
    check_scene(frames, detections)
    rig = RigEstimate.of_frames(frames)
    rig.update(frames, detections)
    RigEstimate.of_frames(frames).load_state_dict(rig.state_dict())
    boxes = torch.tensor([[0.0, 0.0, 10.0, 4.0, 1.6, 1.5, 0.3]])
    assert len(fit_shape(torch.zeros(40, 3), boxes, "opencv").cars.to_boxes("opencv")) == 1


def commands(root: Path, out: Path) -> None:
    """Run a refinement and then the commands that read its folder."""
    run(root, out)
    data, labels, results = data_options(root), str(root / "training" / "label_2"), str(out / "out" / "data")
    with_prior = [*data, "--prior", str(root / "prior.safetensors")]
    for command in (
        ["refine", *with_prior, "--out", str(out / "refined"), "--set", ONE_STEP, "--frames", "000000"],
        ["check-data", *data, "--frames", "000000"],
        ["status", str(out / "out")],
        ["report", str(out / "out"), "--html", str(out / "page.html"), *with_prior],
        ["export", str(out / "out"), "--out", str(out / "exports"), "--format", "glb", "kitti", *with_prior],
        ["compare", "--labels", labels, "--before", str(root / "detections"), "--after", results, "--frames", "0"],
        ["evaluate", "--labels", labels, "--results", str(root / "detections")],
        ["calibrate-rig", *data, "--out", str(out / "rig.json")],
        ["inspect", "--frames", "000000", "--car", "1", *with_prior, "--set", ONE_STEP, "--out", str(out / "f")],
    ):
        assert main(command) == 0, command
    with suppress(SystemExit):
        main(["no-such-command"])


CALLS = (forward, gradient, tensors, failing_command, failing_run, priors, commands, write)


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
