"""This module compares refinements on the CPU and a simulated card in a separate process.

`python -m helpers.card_cases FILE CASE ..` writes a JSON object: for each case the largest difference, or the waits of
the host.
"""

from __future__ import annotations

import copy
import filecmp
import json
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unittest import mock

import on_a_gpu
import torch
from benchmark_suites.workloads import demo_scene
from torch import Tensor

from directshape_torch.cli.main import main as command
from directshape_torch.config import RefinerConfig
from directshape_torch.io.config_files import load_config
from directshape_torch.kernels.choice import without_kernels
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops
from directshape_torch.shape.shape_prior import ShapePrior
from helpers.car_counts import with_cars
from helpers.five_cars import five_cars, with_solver
from helpers.kitti_folder import input_options, write_data_set
from helpers.pretended_card import CARD, CardTensor, noted_waits, pretended_card
from helpers.priors import prior_of
from helpers.problems import DEFAULT, GEOMETRIC
from helpers.synthetic_scene import disturbed, measured_street

_SHIPPED = load_config("default")
# What two iterations do, all do; `default` goes on until cars leave.
_FEW_STEPS = replace(DEFAULT, stages=tuple(replace(stage, max_iterations=2) for stage in DEFAULT.stages))
_SIGMAS = {"pose_sigma_along_m": 0.5, "pose_sigma_across_m": 0.3, "pose_sigma_vertical_m": 0.2}

SETTINGS: dict[str, RefinerConfig] = {
    "default": _SHIPPED,
    "product form, marched rays": with_solver(
        replace(_FEW_STEPS, silhouette=replace(DEFAULT.silhouette, form="product")), rays="marched"
    ),
    "point cloud": replace(GEOMETRIC, stages=GEOMETRIC.stages[:4]),
    "implicit gradients": replace(DEFAULT, backward=replace(DEFAULT.backward, mode="implicit")),
}

OTHER_FORMS = with_solver(
    replace(
        _FEW_STEPS,
        photometric=replace(DEFAULT.photometric, brightness="affine", pixel_set="hit"),
        sampling=replace(DEFAULT.sampling, mode="uniform"),
        priors=replace(DEFAULT.priors, tilt_form="cosine", **_SIGMAS),
    ),
    initial_damping=0.0,
    accept_every_step=True,
)
# Views of tracks and cars by themselves are both differentiated with these settings, in one stage.
UNROLLED = replace(_FEW_STEPS, stages=_FEW_STEPS.stages[-1:], backward=replace(DEFAULT.backward, mode="unroll"))


def compare(config: RefinerConfig, prior: ShapePrior | None = None, tracks: bool = False) -> dict[str, float]:
    """The largest difference between the devices of each figure and its gradients."""
    if not config.fits_points:
        street_prior, frames, detections = _numbered() if tracks else five_cars()
    else:
        street_prior, street = measured_street()
        frames, detections = street.frames, disturbed(street.detections, 0.25, 0.08)
    prior = street_prior if prior is None else prior
    expected = _figures(DirectShapeRefiner(prior, config), frames, detections, torch.device("cpu"))
    found = _figures(DirectShapeRefiner(copy.deepcopy(prior).to(CARD), config), frames, detections, CARD)
    return {name: _difference(found[name], expected[name]) for name in expected}


def _numbered() -> tuple[ShapePrior, FrameBatch, Detections]:
    """The five cars, with cars of equal shape as views of one track."""
    prior, frames, detections = five_cars()
    return prior, frames, replace(detections, track_id=torch.tensor([0, 1, -1, 0, 1]))


def _figures(
    refiner: DirectShapeRefiner, frames: FrameBatch, detections: Detections, device: torch.device
) -> dict[str, Tensor]:
    """All tensors of a result, on the CPU; they must have been on the device."""
    differentiate = refiner.config.backward.mode != "none"
    images = frames.images_right.detach().clone().requires_grad_(differentiate)
    weights = {"shape": torch.linspace(0.5, 1.0, len(detections), dtype=images.dtype, device=device)}
    frames = replace(frames, images_right=images).to(device)
    result = refiner(frames, detections.to(device), weights)
    figures = _tensors(result)
    away = [name for name, tensor in figures.items() if tensor.device != device]
    assert not away, f"not on {device}: {away}"
    figures["boxes"] = torch.as_tensor(result.boxes().location_ref)
    row = [status.is_refined for status in result.status].index(True)
    figures["mesh"] = torch.as_tensor(result.mesh(row).vertices)
    if differentiate:
        (result.T_cam_obj.sum() + result.code.sum()).backward()
        assert images.grad is not None
        figures["gradient"] = images.grad
    return {name: tensor.detach().cpu() for name, tensor in figures.items()}


def _tensors(result: RefinementResult) -> dict[str, Tensor]:
    parts = [result, result.quality, result.observability, result.profile]
    return {
        f"{type(part).__name__}.{f.name}": value
        for part in parts
        for f in fields(part)
        if isinstance(value := getattr(part, f.name), Tensor)
    }


def _difference(found: Tensor, expected: Tensor) -> float:
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return float("inf")
    if found.numel() == 0 or torch.equal(found.nan_to_num(), expected.nan_to_num()):
        return 0.0 if torch.equal(found.isnan(), expected.isnan()) else float("inf")
    return float((found.double() - expected.double()).abs().nan_to_num(nan=torch.inf).max())


def waits_of_blocks(tracks: bool = False) -> dict[str, Any]:
    """Waits of the host, by operation, in calls of one and two blocks a stage, and in one where cars end early."""
    prior, frames, detections = _numbered() if tracks else five_cars()
    inputs = frames.to(CARD), detections.to(CARD)
    block = 2
    leaving = with_solver(replace(_SHIPPED, check="off"), cost_tolerance=0.1, block_iterations=block)
    staying = with_solver(leaving, cost_tolerance=0.0, step_tolerance=0.0)
    of_config = _SHIPPED.stages[-1:] if tracks else _SHIPPED.stages

    def counted(config: RefinerConfig, iterations: int) -> tuple[dict[str, int], list[int]]:
        stages = tuple(replace(stage, max_iterations=iterations) for stage in of_config)
        refiner = DirectShapeRefiner(copy.deepcopy(prior).to(CARD), replace(config, stages=stages))
        with noted_waits() as waits:
            result = refiner(*inputs)
        return Counter(waits), result.iterations.tolist()

    counted(staying, 1)  # sends the constants
    one, two, left = counted(staying, block), counted(staying, 2 * block), counted(leaving, 2 * block)
    return {
        "stages": len(of_config),
        "blocks of cars": [-(-count // block) for count in left[1]],
        "one block": one[0],
        "two blocks": two[0],
        "cars end": left[0],
    }


def waits_of_masks() -> dict[str, Any]:
    """Number of waits of the host while it makes crops of few masks and of many, by their form."""

    forms: dict[str, Callable[[Tensor], Any]] = {
        "dense": MaskCrops.of,
        "entries": lambda masks: MaskCrops.of([None, *masks]),
        "bytes": lambda masks: MaskCrops.of(list((masks * 255).byte())),
        "boxes": lambda masks: MaskCrops.of_boxes(
            [*zip(torch.tensor([0, 0, 10, 8]).repeat(len(masks), 1).to(CARD), masks, strict=True)],
            (8, 10),
            masks,
        ),
        "areas and boxes": lambda masks: MaskCrops.of(masks).box_2d,
    }
    counts: dict[str, list[int]] = {}
    for name, make in forms.items():
        for number in (2, 20):
            masks = torch.rand(number, 8, 10).to(CARD)
            with noted_waits() as waits:
                make(masks)
            counts.setdefault(name, []).append(len(waits))
    return counts


def waits_of_nothing() -> dict[str, Any]:
    """The noted waits of a program that mixes devices, and of one that reads, which must be noted."""
    x = torch.arange(6, device=CARD).view(2, 3)
    problems = []
    number, of_card = torch.tensor(1.0), x[0, 0].float()
    for mix in (
        lambda: x + torch.ones(3),
        lambda: torch.cat([x, torch.ones(1, 3)]),
        lambda: torch.stack([of_card, number]),
        lambda: number.clone().add_(of_card),
    ):
        try:
            mix()
        except RuntimeError as error:
            problems.append(str(error))
    with noted_waits() as waits:
        assert isinstance(x + 1, CardTensor)
        assert isinstance(of_card + number, CardTensor)
        float(x.sum()), x.tolist(), x.nonzero(), x[x > 2], x.cpu(), torch.ones(2).to(CARD), x.new_tensor([1, 2])
        torch.linalg.eigh(torch.eye(2, device=CARD))
    return {"problems": len(problems), "waits": waits}


def run_of_files() -> dict[str, list[str]]:
    """Files of a run over a data set that differ between the devices; the card has no native loops."""
    with tempfile.TemporaryDirectory() as folder, without_kernels():
        roots = [Path(folder) / device for device in ("cpu", "card")]
        write_data_set(data := Path(folder) / "data", ("000000",))
        for root in roots:
            words = [*input_options(data)[:-1], root.name, "--rig", "none", "--overlays"]
            assert command(["refine", *words, "--out", str(root)]) == 0
        names = sorted({str(p.relative_to(root)) for root in roots for p in root.rglob("*") if p.is_file()})
        _, differ, missing = filecmp.cmpfiles(*roots, names, shallow=False)
    return {"names": names, "differ": [*differ, *missing]}


def page() -> str:
    """The page of `scripts/on_a_gpu.py`, for one car and few iterations."""
    with (
        tempfile.TemporaryDirectory() as folder,
        without_kernels(),
        mock.patch.object(on_a_gpu, "_inputs", _one_car),
        mock.patch.object(on_a_gpu, "load_config", _few_iterations),
    ):
        file = Path(folder) / "gpu.md"
        assert on_a_gpu.main(["--device", "card", "--quick", "--out", str(file)]) == 0
        return file.read_text()


def _one_car(num_frames: int) -> tuple[FrameBatch, Detections]:
    return with_cars(demo_scene().frames, num_frames)


def _few_iterations(preset: str, words: list[str]) -> RefinerConfig:
    trusting = "acceptance={min_probability_better: 0, min_probability_not_worse: 0}"
    stage = "stages=[{contour_width_px: 2, image_level: 1, max_iterations: 3}]"
    return load_config(preset, [*words, trusting, stage, "search=off", "check=off"])


CASES: dict[str, Callable[[], Any]] = {
    **{name: lambda config=config: compare(config) for name, config in SETTINGS.items()},  # type: ignore[misc]
    "neural prior, other residuals and priors, every step": lambda: compare(OTHER_FORMS, prior_of("neural")),
    "tracks, unrolled gradients": lambda: compare(UNROLLED, tracks=True),
    "waits of blocks": waits_of_blocks,
    "waits of blocks of tracks": lambda: waits_of_blocks(tracks=True),
    "waits of masks": waits_of_masks,
    "the card itself": waits_of_nothing,
    "run": run_of_files,
    "page": page,
}


def main() -> None:
    found = {}
    with pretended_card():
        for name in sys.argv[2:]:
            try:
                found[name] = CASES[name]()
            except Exception:
                found[name] = {"error": traceback.format_exc()}
            print(name, file=sys.stderr, flush=True)
    Path(sys.argv[1]).write_text(json.dumps(found))


if __name__ == "__main__":
    main()
