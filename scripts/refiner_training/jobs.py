"""The work in pieces for two processes: the fixed default, and for each fold the constants and the network."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Literal, NoReturn

import torch
from torch import Tensor
from tqdm import tqdm

from directshape_torch.config import BackwardConfig
from directshape_torch.config_files import load_config
from directshape_torch.evaluation.comparison import ComparedCar
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from refiner_training.car_frames import CarFrame, prepare_frame
from refiner_training.evaluation import refine_and_compare
from refiner_training.networks import ConstantCorrector, CropNetwork, Parts
from refiner_training.training import Epoch, TrainingSettings, train

BackwardMode = Literal["unroll", "implicit", "implicit_gauss_newton"]
Kind = Literal["fixed", "constant", "network"]

# Beside `fast.yaml`, whatever that one has of these. Costs are means over pixels, so weights keep their meaning.
# A result that is not returned has no gradient and says nothing of what a network has learnt.
EVERY_RESULT = "acceptance.min_probability_better=0"
TRAINING_OVERRIDES = (
    "sampling.min_pixels=200",
    "sampling.max_pixels=200",
    "sampling.mode_right=as_left",
    "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 6}, "
    "{contour_width_px: 0.5, image_level: 0, max_iterations: 8}]",
    EVERY_RESULT,
)
UNROLLED_ITERATIONS = 3


@dataclass(frozen=True)
class Options:
    """Everything that decides the outcome."""

    data: Path
    detections: Path
    masks: Path
    frames: tuple[str, ...] | None
    parts: Parts
    mode: BackwardMode
    folds: int
    constant_rate: float
    network_rate: float
    training: TrainingSettings


@dataclass(frozen=True)
class Job:
    """One piece of work; `fold` is the part of the frames that is held out."""

    kind: Kind
    fold: int


@dataclass(frozen=True)
class Outcome:
    """What a job gives back: held-out cars with the default settings, the training, its parameters."""

    job: Job
    cars: tuple[ComparedCar, ...]
    epochs: tuple[Epoch, ...]
    parameters: dict[str, Tensor]


def folds_of(frame_ids: Sequence[str], num_folds: int, seed: int) -> dict[str, int]:
    """Which fold each frame belongs to: a seeded shuffle dealt out in turn.

    Examples:
        >>> sorted(folds_of(["a", "b", "c", "d"], 2, 0).values())
        [0, 0, 1, 1]
    """
    order = torch.randperm(len(frame_ids), generator=torch.Generator().manual_seed(seed)).tolist()
    return {frame_ids[k]: place % num_folds for place, k in enumerate(order)}


@lru_cache(maxsize=1)
def load_frames(options: Options) -> tuple[CarFrame, ...]:
    """All frames, once for each process."""
    dataset = KittiStereoDataset(options.data, options.detections, options.masks, frames=options.frames)
    return tuple(prepare_frame(dataset.load(frame_id)) for frame_id in dataset.frame_ids)


def training_refiner(mode: BackwardMode) -> DirectShapeRefiner:
    """The refiner of the training: fewer iterations, ray samples and pixels, with gradients."""
    config = load_config("fast", TRAINING_OVERRIDES)
    return DirectShapeRefiner(config=replace(config, backward=BackwardConfig(mode, UNROLLED_ITERATIONS)))


def run_job(job: Job, options: Options, on_epoch: Callable[[], None] = lambda: None) -> Outcome:
    """Train on the frames of the other folds and judge the others with the default settings, every result returned."""
    frames, refiner = load_frames(options), DirectShapeRefiner(config=load_config("default", [EVERY_RESULT]))
    if job.kind == "fixed":
        return Outcome(job, tuple(refine_and_compare(refiner, None, frames)), (), {})
    fold_of = folds_of([frame.loaded.frame_id for frame in frames], options.folds, options.training.seed)
    seen = [frame for frame in frames if fold_of[frame.loaded.frame_id] != job.fold]
    held_out = [frame for frame in frames if fold_of[frame.loaded.frame_id] == job.fold]
    torch.manual_seed(options.training.seed + job.fold)
    corrector: ConstantCorrector | CropNetwork
    if job.kind == "constant":
        corrector = ConstantCorrector(options.parts)
        settings = replace(options.training, rate=options.constant_rate, weight_decay=0.0)
    else:
        corrector = CropNetwork(options.parts)
        settings = replace(options.training, rate=options.network_rate)
    epochs = train(training_refiner(options.mode), corrector, seen, held_out, settings, on_epoch)
    cars = refine_and_compare(refiner, corrector, held_out)
    return Outcome(job, tuple(cars), tuple(epochs), dict(corrector.state_dict()))


def run_jobs(jobs: Sequence[Job], options: Options, processes: int) -> list[Outcome]:
    """All jobs in order, in several processes, with a progress bar over epochs."""
    total = options.training.epochs * sum(job.kind != "fixed" for job in jobs)
    with tqdm(total=total, unit="epoch", desc="train") as bar:
        if processes == 1:
            return [run_job(job, options, lambda: advance(bar, 1)) for job in jobs]
        context = multiprocessing.get_context("spawn")
        finished = context.Value("i", 0)
        with context.Pool(processes, _start_worker, (finished, torch.get_num_threads())) as pool:
            waiting = pool.starmap_async(run_counted, [(job, options) for job in jobs], chunksize=1)
            while not waiting.ready():
                waiting.wait(1.0)
                advance(bar, finished.value - int(bar.n))
            return waiting.get()


def advance(bar: tqdm[NoReturn], epochs: int) -> None:
    """Move the bar, but do not print it again for nothing."""
    if epochs:
        bar.update(epochs)


def run_counted(job: Job, options: Options) -> Outcome:
    """`run_job` in a worker, counting epochs for the parent's progress bar."""
    counter = _worker_counter[0]

    def count() -> None:
        with counter.get_lock():
            counter.value += 1

    return run_job(job, options, count)


_worker_counter: list[Synchronized[int]] = []


def _start_worker(counter: Synchronized[int], num_threads: int) -> None:
    torch.set_num_threads(num_threads)
    _worker_counter.append(counter)
