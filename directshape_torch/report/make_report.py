"""The page of a run, written frame by frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import TextIOWrapper
from pathlib import Path
from typing import IO

from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.batch.options import RunObserver
from directshape_torch.batch.run_log import read_log
from directshape_torch.batch.run_status import read_status
from directshape_torch.config import RefinerConfig
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import replaced_file
from directshape_torch.io.run_folder import RunFolder, shapes_path
from directshape_torch.io.stereo_files import FileStereoDataset
from directshape_torch.report.car_rows import CAR_COLUMNS, CarRow, as_json, car_rows, choose_frames
from directshape_torch.report.drawn_cars import decoded_mesh
from directshape_torch.report.frame_details import DetailSettings, FrameMaterial, frame_details
from directshape_torch.report.frame_inputs import InputReader
from directshape_torch.report.page_assets import data_block, page_frame
from directshape_torch.report.page_data import mesh_data
from directshape_torch.report.residual_maps import MapSettings
from directshape_torch.report.run_facts import problem_notes, run_facts
from directshape_torch.shape.shape_prior import ShapePrior


@dataclass(frozen=True)
class ReportOutcome:
    """What was written.

    Attributes:
        path: the page.
        num_bytes: its size.
        num_frames, num_detailed, num_cars: frames, those with details, and cars.
        notes: what the page lacks, as it says itself.
    """

    path: Path
    num_bytes: int
    num_frames: int
    num_detailed: int
    num_cars: int
    notes: tuple[str, ...]


def make_report(
    run: RunFolder,
    page: Path,
    dataset: FileStereoDataset | None = None,
    prior: ShapePrior | None = None,
    *,
    has_detections: bool = True,
    most_frames: int = 100,
    observer: RunObserver | None = None,
) -> ReportOutcome:
    """Write the page of the chosen frames of a run.

    Args:
        run: the output folder of `directshape refine`.
        page: the HTML file to write.
        dataset: the frames of the run, for what went in.
        prior: the shapes of the run; None, or another one than the run's: boxes alone, without meshes.
        has_detections: whether the detections of the data set are those of the run.
        most_frames: frames with pictures and 3D views at most; all cars are in the table all the same.
        observer: is told of each frame with details.

    Raises:
        DataFormatError: a damaged file in the run.
        ConfigError: its settings are not those of this version.
        InputError: `most_frames` is negative.
    """
    if most_frames < 0:
        raise InputError("most_frames", "0 or more", str(most_frames))
    right = None if prior is None or run.manifest.sha256["prior"] != hash_prior(prior) else prior
    writer = _PageOfRun(run, dataset, dataset is not None and has_detections, right, prior is not None)
    return writer.write(page, most_frames, RunObserver() if observer is None else observer)


class _PageOfRun:
    def __init__(
        self,
        run: RunFolder,
        dataset: FileStereoDataset | None,
        has_detections: bool,
        prior: ShapePrior | None,
        prior_was_given: bool,
    ) -> None:
        self._run, self._dataset = run, dataset
        self._config = run.refiner_config()
        # One for all frames and one for those with details: each counts what it could not use.
        self._reader, self._detail_reader = (InputReader(dataset, has_detections) for _ in range(2))
        self._grounds: Counter[str] = Counter()
        self._prior, self._prior_was_given = prior, prior_was_given

    def write(self, page: Path, most_frames: int, observer: RunObserver) -> ReportOutcome:
        frame_ids = self._run.frame_ids
        rows = [row for number, name in enumerate(frame_ids) for row in self._rows(number, name)]
        detailed = choose_frames(rows, len(frame_ids), most_frames)
        frame = page_frame(f"{self._run.path.resolve().name}: refined cars")
        with replaced_file(page) as content, TextIOWrapper(content, "utf-8", "replace", newline="\n") as file:
            file.write(frame.head)
            self._write_details(file, frame_ids, detailed, observer)
            notes = self._notes(len(frame_ids), len(detailed))
            self._write_tables(file, frame_ids, detailed, rows, notes)
            file.write(frame.foot)
        return ReportOutcome(page, page.stat().st_size, len(frame_ids), len(detailed), len(rows), tuple(notes))

    def _rows(self, number: int, frame_id: str) -> list[CarRow]:
        known = self._known(frame_id)
        self._grounds[known.result.shapes.ground_source] += 1
        return car_rows(number, known.result, known.detections, known.labels)

    def _known(self, frame_id: str) -> FrameMaterial:
        """A frame without its images."""
        result = self._run.read(frame_id)
        lines, classes = self._reader.detections(result), self._run.classes
        detections = None if lines is None else [one for one in lines if one.type in classes and one.has_box_3d]
        if detections is not None and len(detections) != len(result.cars):
            raise DataFormatError(shapes_path(self._run.path, frame_id), "does not have the cars of its detection file")
        return FrameMaterial(result, None, detections, self._reader.labels(frame_id))

    def _write_details(
        self,
        file: IO[str],
        frame_ids: Sequence[str],
        detailed: Sequence[int],
        observer: RunObserver,
    ) -> None:
        settings = self._detail_settings()
        if settings.mean is not None:
            file.write(data_block("mean-mesh", mesh_data(settings.mean.vertices_obj, settings.mean.faces)))
        names = [frame_ids[number] for number in detailed]
        observer.started(names)
        for number, name in zip(detailed, names, strict=True):
            known = self._known(name)
            material = replace(known, loaded=self._detail_reader.read(known.result))
            for part, value in frame_details(material, settings).items():
                file.write(data_block(f"{part}-{number}", value))
            observer.finished(name, None)

    def _detail_settings(self) -> DetailSettings:
        mean = None if self._prior is None else decoded_mesh(self._prior, self._prior.initial_code(1)[0].cpu().numpy())
        order = self._config.sampling.occlusion_order
        return DetailSettings(self._run.classes, self._prior, mean, map_settings(self._config), order)

    def _notes(self, num_frames: int, num_detailed: int) -> list[str]:
        dataset = self._dataset
        notes = _unfinished(self._run.path)
        if dataset is None:
            notes.append("no pictures and no residual maps: the images were not given (--data)")
        if not self._reader.has_detections:
            notes.append("nothing from before the refinement: the detections were not given (--detections)")
        if dataset is not None and dataset.masks is None:
            notes.append("no silhouette residuals: the masks were not given (--masks)")
        if self._prior is None:
            reason = "the prior is not that of the run" if self._prior_was_given else "the prior was not given"
            notes.append(f"no residual maps, and no meshes but saved ones: {reason} (--prior)")
        has_field = self._run.manifest.sha256["stereo_bias"] is not None
        if has_field and dataset is not None and not dataset.disparity_fields:
            notes.append("photometric residuals without the run's disparity field, so biased (--rig)")
        if num_detailed < num_frames:
            notes.append(f"pictures and 3D views of {num_detailed} of {num_frames} frames (--max-frames)")
        notes += problem_notes(self._reader.problems, num_frames)
        return notes + problem_notes(self._detail_reader.problems, num_detailed)

    def _write_tables(
        self,
        file: IO[str],
        frame_ids: Sequence[str],
        detailed: Sequence[int],
        rows: Sequence[CarRow],
        notes: Sequence[str],
    ) -> None:
        file.write(data_block("frames", {"ids": list(frame_ids), "detailed": list(detailed)}))
        file.write(data_block("cars", {"columns": CAR_COLUMNS, "rows": [as_json(row) for row in rows]}))
        file.write(data_block("run", run_facts(self._run, frame_ids, rows, self._grounds, notes)))


def _unfinished(out_dir: Path) -> list[str]:
    """A note on how the run stands where it has not finished."""
    if read_log(out_dir) is None:
        return []
    status = read_status(out_dir)
    left = f"{status.state}, {status.num_left} frames left"
    return [] if status.state == "finished" else [f"the run has not finished ({left}): the page is of what is done"]


def map_settings(config: RefinerConfig) -> MapSettings:
    """Settings of residual maps from those of a run."""
    return MapSettings(
        contour_width_px=config.stages[-1].contour_width_px,
        probability_floor=config.silhouette.probability_floor,
        matches_brightness=config.photometric.brightness != "none",
    )
