"""The page of a run, written frame by frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import IO, Any, TypedDict, cast, get_args

from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.batch.options import RunObserver, SilentObserver
from directshape_torch.batch.run_log import read_log
from directshape_torch.batch.run_status import read_status
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import replaced_file
from directshape_torch.files.schema import check_type
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult, RunFolder, shapes_path, summary_path
from directshape_torch.observation.occlusion import OcclusionOrder
from directshape_torch.report.car_rows import CAR_COLUMNS, CarRow, as_json, car_rows
from directshape_torch.report.chosen_frames import choose_frames
from directshape_torch.report.drawn_frame import decoded_mesh
from directshape_torch.report.frame_details import frame_details
from directshape_torch.report.frame_inputs import InputReader, InputSources
from directshape_torch.report.frame_material import DetailSettings, FrameMaterial
from directshape_torch.report.mesh_data import mesh_data
from directshape_torch.report.page_assets import data_block, page_frame
from directshape_torch.report.residual_maps import MapSettings
from directshape_torch.report.run_facts import problem_notes, run_facts
from directshape_torch.shape.shape_prior import ShapePrior


@dataclass(frozen=True)
class ReportOptions:
    """What a page shows.

    Attributes:
        frames: ids of the frames to report on; None: all that are done.
        most_frames: frames with pictures and 3D views at most; all cars are in the table all the same.

    Raises:
        InputError: a negative number.
    """

    frames: Sequence[str] | None = None
    most_frames: int = 100

    def __post_init__(self) -> None:
        if self.most_frames < 0:
            raise InputError("most_frames", "0 or more", str(self.most_frames))


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
    out_dir: Path,
    page: Path,
    sources: InputSources,
    prior: ShapePrior | None = None,
    options: ReportOptions | None = None,
    observer: RunObserver | None = None,
) -> ReportOutcome:
    """Write the page of a run.

    Args:
        out_dir: of `directshape refine`.
        page: the HTML file to write.
        sources: where the inputs lie.
        prior: the shapes of the run; None, or another one than the run's: boxes alone, without meshes.
        options: what to show.
        observer: is told of each frame with details.

    Raises:
        DataFormatError: no run, or a damaged file in it.
        InputError: a frame that the run does not have.
    """
    options = ReportOptions() if options is None else options
    run = RunFolder(out_dir, options.frames)
    writer = _PageOfRun(run, sources, _right_prior(run, prior), prior is not None)
    return writer.write(page, options, SilentObserver() if observer is None else observer)


def _right_prior(run: RunFolder, prior: ShapePrior | None) -> ShapePrior | None:
    """The prior, if its codes are those of the run."""
    if prior is None or run.manifest.sha256.get("prior") not in (None, hash_prior(prior)):
        return None
    return prior


class _PageOfRun:
    def __init__(self, run: RunFolder, sources: InputSources, prior: ShapePrior | None, prior_was_given: bool) -> None:
        self._run = run
        # One for all frames and one for those with details: each counts what it could not use.
        height_m = float(run.setting("camera_height_m"))
        self._reader, self._detail_reader = (InputReader(sources, height_m) for _ in range(2))
        self._grounds: Counter[str] = Counter()
        self._prior = prior
        self._prior_was_given = prior_was_given

    def write(self, page: Path, options: ReportOptions, observer: RunObserver) -> ReportOutcome:
        frame_ids = self._run.frame_ids
        rows = [row for number, name in enumerate(frame_ids) for row in self._rows(number, name)]
        detailed = choose_frames(rows, len(frame_ids), options.most_frames)
        frame = page_frame(f"{self._run.path.resolve().name}: refined cars")
        with replaced_file(page) as content, TextIOWrapper(content, "utf-8", "replace", newline="\n") as file:
            file.write(frame.head)
            self._write_details(file, frame_ids, detailed, observer)
            notes = self._notes(len(frame_ids), len(detailed))
            self._write_tables(file, frame_ids, detailed, rows, notes)
            file.write(frame.foot)
        return ReportOutcome(page, page.stat().st_size, len(frame_ids), len(detailed), len(rows), tuple(notes))

    def _rows(self, number: int, frame_id: str) -> list[CarRow]:
        material = self._results(frame_id)
        self._grounds[material.result.shapes.ground_source] += 1
        return car_rows(number, material.result, material.detections, material.labels)

    def _results(self, frame_id: str) -> _Results:
        result = self._run.read(frame_id)
        lines, classes = self._reader.detections(result), self._run.classes
        detections = None if lines is None else [one for one in lines if one.type in classes and one.has_box_3d]
        if detections is not None and len(detections) != len(result.cars):
            raise DataFormatError(shapes_path(self._run.path, frame_id), "does not have the cars of its detection file")
        return _Results(result, lines, detections, self._reader.labels(frame_id))

    def _write_details(
        self,
        file: IO[str],
        frame_ids: Sequence[str],
        detailed: Sequence[int],
        observer: RunObserver,
    ) -> None:
        settings = self._detail_settings()
        if settings.mean is not None:
            file.write(data_block("mean-mesh", mesh_data(settings.mean)))
        names = [frame_ids[number] for number in detailed]
        observer.started(names)
        for number, name in zip(detailed, names, strict=True):
            known = self._results(name)
            material = FrameMaterial(
                known.result, self._detail_reader.read(known.result), known.lines, known.detections, known.labels
            )
            details = frame_details(material, settings)
            file.write(data_block(f"thumbnails-{number}", details.thumbnails))
            file.write(data_block(f"maps-{number}", details.maps))
            file.write(data_block(f"scene-{number}", details.scene))
            observer.finished(name, None)

    def _detail_settings(self) -> DetailSettings:
        config = self._run.manifest.config
        refiner = config.get("refiner", {})
        check_type(summary_path(self._run.path), "config['refiner']", refiner, _DrawnSettings)
        mean = None if self._prior is None else decoded_mesh(self._prior, self._prior.initial_code(1)[0].cpu().numpy())
        order = refiner.get("sampling", {}).get("occlusion_order", "depth")
        known = order if order in get_args(OcclusionOrder) else "depth"
        return DetailSettings(self._run.classes, self._prior, mean, map_settings(refiner), cast(OcclusionOrder, known))

    def _notes(self, num_frames: int, num_detailed: int) -> list[str]:
        sources = self._reader.sources
        notes = _unfinished(self._run.path)
        if sources.layout is None:
            notes.append("no pictures and no residual maps: the images were not given (--data)")
        if not sources.has_detections:
            notes.append("nothing from before the refinement: the detections were not given (--detections)")
        if sources.masks is None and sources.layout is not None:
            notes.append("no silhouette residuals: the masks were not given (--masks)")
        if self._prior is None:
            reason = "the prior is not that of the run" if self._prior_was_given else "the prior was not given"
            notes.append(f"no residual maps, and no meshes but saved ones: {reason} (--prior)")
        has_field = self._run.manifest.sha256.get("stereo_bias") is not None
        if has_field and sources.layout is not None and not sources.disparity_fields:
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


class _Silhouette(TypedDict, total=False):
    probability_floor: float


class _Stage(TypedDict, total=False):
    contour_width_px: float


class _DrawnSettings(TypedDict, total=False):
    """Those of the refiner that pictures need."""

    stages: list[_Stage]
    silhouette: _Silhouette
    photometric: dict[str, Any]
    sampling: dict[str, Any]


@dataclass(frozen=True)
class _Results:
    """A frame without its images."""

    result: FrameResult
    lines: list[KittiObject] | None
    detections: list[KittiObject] | None
    labels: list[KittiObject] | None


def map_settings(refiner: dict[str, Any]) -> MapSettings:
    """Settings of residual maps from those of a run; what a run does not say has its default."""
    stages, silhouette = refiner.get("stages", ()), refiner.get("silhouette", {})
    given = {name: silhouette[name] for name in ("probability_floor",) if name in silhouette}
    if stages:
        given["contour_width_px"] = stages[-1].get("contour_width_px", MapSettings.contour_width_px)
    brightness = refiner.get("photometric", {}).get("brightness", "gain")
    return MapSettings(**given, matches_brightness=brightness != "none")
