"""Runs of the refiner, each in a folder of its own that a second call finds again, and how they are compared."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.batch.refine_dataset import refine_dataset, run_manifest
from directshape_torch.cli.options import find_device
from directshape_torch.config_files import load_config
from directshape_torch.evaluation.bootstrap import BootstrapSettings
from directshape_torch.evaluation.comparison import Comparison, compare_results, lines_with_left_mask
from directshape_torch.files.atomic_files import write_json
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import shapes_path
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.rig_file import load_fields
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.status import Status
from paper_tables.data_sets import DataSet
from paper_tables.rows import DEFAULT, Settings
from paper_tables.variants import ExposedDataset, masks_for

QUICK_FRAMES = 2


@dataclass(frozen=True)
class Run:
    """A finished refinement.

    Attributes:
        out: its folder, as `directshape refine` writes it.
        before: folder of the detections that went in.
        frame_ids: the frames asked for.
        seconds: by frame the processor time of the refiner, and its cars; frames of earlier calls included.
    """

    out: Path
    before: Path
    frame_ids: tuple[str, ...]
    seconds: dict[str, tuple[float, int]]

    @property
    def mean_iterations(self) -> float:
        """Gauss-Newton iterations a refined car; NaN without one."""
        counts: list[int] = []
        refined = {status.name for status in Status if status.is_refined}
        for frame_id in self.frame_ids:
            shapes = read_shapes(shapes_path(self.out, frame_id))
            counts += [
                int(n) for n, status in zip(shapes.iterations, shapes.statuses, strict=True) if status in refined
            ]
        return sum(counts) / len(counts) if counts else float("nan")

    def time_ratio(self, reference: Run) -> float:
        """Processor time a car over that of another run, on the frames that both have; NaN without any."""
        common = sorted(set(self.seconds) & set(reference.seconds) & set(self.frame_ids))
        mine, other = (_seconds_per_car([run.seconds[f] for f in common]) for run in (self, reference))
        return mine / other if other > 0 else float("nan")


@dataclass
class Experiment:
    """One call of the program.

    Attributes:
        out: folder of everything that it writes.
        data_sets: to run on.
        fields: residual disparity field by data set, or None.
        device: of the refiner.
        frames: ids, or None for all.
        detectors: names, or None for the table's own choice.
        bootstrap: of the intervals; its seed is that of simulated detections too.
        quick: a few frames and rows, to try everything.
        groups: of the ablation to run beside the reference; empty for all.
        runs: those of this call, by folder and frames.
    """

    out: Path
    data_sets: tuple[DataSet, ...]
    fields: dict[str, Path | None]
    device: str
    frames: tuple[str, ...] | None
    detectors: tuple[str, ...] | None
    bootstrap: BootstrapSettings
    quick: bool
    groups: tuple[str, ...] = ()
    runs: dict[tuple[Path, tuple[str, ...]], Run] = field(default_factory=dict)

    def detectors_of(self, data_set: DataSet) -> dict[str, Path]:
        """Folders of detections by name, those that the user chose."""
        chosen = data_set.detections if self.detectors is None else self.detectors
        return {name: data_set.detections[name] for name in chosen if name in data_set.detections}

    def frames_of(self, data_set: DataSet, detections: Path) -> tuple[str, ...]:
        """Frames of a detector that this call is about."""
        frames = data_set.frames_of(detections, self.frames)
        return frames[:QUICK_FRAMES] if self.quick else frames

    def run(self, data_set: DataSet, detections: Path, settings: Settings) -> Run:
        """Refine the frames, those that an earlier call finished excepted.

        Raises:
            DirectShapeError: unusable settings or files; a folder whose files have changed since.
        """
        frame_ids = self.frames_of(data_set, detections)
        config = load_config(settings.config, settings.all_overrides)
        refiner = DirectShapeRefiner(prior_for(settings.prior), config).to(find_device(self.device))
        field_file = self.fields.get(data_set.name) if settings.with_field else None
        dataset = ExposedDataset(
            data_set.root,
            detections,
            masks_for(data_set, detections, settings.masks),
            frames=frame_ids,
            disparity_field=None if field_file is None else load_fields(field_file)[0],
            exposure=settings.exposure,
        )
        out = self._folder(data_set, detections, settings, dataset, refiner)
        if (out, frame_ids) not in self.runs:
            self.runs[out, frame_ids] = _made(dataset, refiner, out)
        return self.runs[out, frame_ids]

    def compare(self, data_set: DataSet, run: Run) -> Comparison:
        """Boxes before and after, in every row of the same cars: those with a mask among the data set's own."""
        masked = self.run(data_set, run.before, DEFAULT).out / "shapes"
        return compare_results(
            data_set.labels,
            run.before,
            run.out / "data",
            frames=run.frame_ids,
            tracks=data_set.tracks,
            keep_line=lines_with_left_mask(masked),
            bootstrap=self.bootstrap,
        )

    def _folder(
        self,
        data_set: DataSet,
        detections: Path,
        settings: Settings,
        dataset: KittiStereoDataset,
        refiner: DirectShapeRefiner,
    ) -> Path:
        """Other settings, prior, field, masks or exposure are another folder."""
        manifest = run_manifest(dataset, refiner, hash_prior(refiner.prior))
        made_of = [manifest.package_version, manifest.config, manifest.sha256, settings.masks, settings.exposure]
        digest = hashlib.sha256(json.dumps(made_of, sort_keys=True, default=list).encode()).hexdigest()[:8]
        return self.out / "runs" / data_set.name / detections.name / f"{settings.slug}-{digest}"


def prior_for(name: str) -> ShapePrior:
    """The prior of a row, `name` as in `Settings.prior`.

    Raises:
        DataFormatError: a file that is no prior.
    """
    kind, _, num_codes = name.partition(":")
    prior = load_prior(kind)
    return prior.with_num_codes(int(num_codes)) if num_codes and isinstance(prior, PCAShapePrior) else prior


def _made(dataset: KittiStereoDataset, refiner: DirectShapeRefiner, out: Path) -> Run:
    with _measured(refiner, out / "processor_seconds.json") as seconds:
        summary = refine_dataset(dataset, refiner, out)
    for frame_id, reason in summary.failed.items():
        print(f"{out.name}: frame {frame_id} failed: {reason}", file=sys.stderr)
    done = tuple(frame_id for frame_id in dataset.frame_ids if frame_id not in summary.failed)
    print(f"{'/'.join(out.parts[-3:])}: {len(done)} frames", file=sys.stderr, flush=True)
    known = {name: (entry[0], int(entry[1])) for name, entry in seconds.items()}
    return Run(out, dataset.detections_dir, done, known)


@contextmanager
def _measured(refiner: DirectShapeRefiner, path: Path) -> Iterator[dict[str, list[float]]]:
    """Notes the processor time of each call of the refiner, which a busy machine changes less than the time of day.

    Yields what is known of each frame, also from earlier calls; written to `path` at the end.
    """
    seconds: dict[str, list[float]] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    began = [0.0]

    def before(_module: torch.nn.Module, _inputs: Any) -> None:
        began[0] = time.process_time()

    def after(_module: torch.nn.Module, inputs: Any, _result: Any) -> None:
        frames, detections = inputs[:2]
        (frame_id,) = frames.frame_ids
        seconds[frame_id] = [time.process_time() - began[0], len(detections)]

    handles = refiner.register_forward_pre_hook(before), refiner.register_forward_hook(after)
    try:
        yield seconds
    finally:
        for handle in handles:
            handle.remove()
        if seconds:
            write_json(path, seconds)


def _seconds_per_car(entries: Sequence[tuple[float, int]]) -> float:
    cars = sum(count for _, count in entries)
    return sum(seconds for seconds, _ in entries) / cars if cars else float("nan")
