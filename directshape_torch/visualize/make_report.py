"""This module writes the page of a run frame by frame, with counts, settings and notes about missing parts."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import replaced_file
from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.run_folder import FrameEntry, RunFolder, frame_entry
from directshape_torch.io.run_manifest import flatten, hash_fields
from directshape_torch.io.run_status import read_status
from directshape_torch.refinement.trust import WORSE_BY
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.rig_file import RIG_FILE, RIG_PICTURE, load_rigs
from directshape_torch.status import Status
from directshape_torch.visualize.car_rows import CarRow, car_rows, choose_frames
from directshape_torch.visualize.frame_details import frame_details
from directshape_torch.visualize.page_parts import data_block, data_url, mesh_data, page_frame
from directshape_torch.visualize.run_frames import RunFrame, RunInputs
from directshape_torch.visualize.verdict import verdict


@dataclass(frozen=True)
class ReportOutcome:
    """A `ReportOutcome` says what was written."""

    path: Path
    num_bytes: int
    num_frames: int
    num_detailed: int  # frames with pictures
    num_cars: int
    notes: tuple[str, ...]  # missing parts of the page, as the page itself says


def make_report(
    inputs: RunInputs, page: Path, *, most_frames: int = 100, tell: Callable[[str], object] = lambda _: None
) -> ReportOutcome:
    """Write the page of the chosen frames of a run.

    Args:
        inputs: chosen frames of the output folder of `directshape refine`, and the inputs of the run. Without the shape
            prior the page has only boxes.
        page: the HTML file to write.
        most_frames: maximum number of frames with pictures and 3D views; the table has all cars in any case.
        tell: function that is called after each frame with details.

    Raises:
        DataFormatError: a file of the run is damaged.
        ConfigError: the settings of the run do not fit this version.
        InputError: `most_frames` is negative.
    """
    if most_frames < 0:
        raise InputError("most_frames", "0 or more", str(most_frames))
    run, mean, config = inputs.run, inputs.mean, inputs.run.refiner_config()
    rows: list[CarRow] = []
    entries: dict[str, FrameEntry] = {}
    for number, frame_id in enumerate(run.frame_ids):
        frame = RunFrame(inputs, frame_id)
        entries[frame_id] = frame_entry(frame.result.shapes, frame.result.record)
        rows += car_rows(number, frame.result, frame.detections, frame.labels)
    detailed = choose_frames(rows, len(run.frame_ids), most_frames)
    head, foot = page_frame(f"{run.path.resolve().name}: refined cars")
    with replaced_file(page) as content, TextIOWrapper(content, "utf-8", "replace", newline="\n") as file:
        file.write(head)
        if mean is not None:
            file.write(data_block("mean-mesh", mesh_data(mean.vertices, mean.faces)))
        for number in detailed:
            for part, value in frame_details(RunFrame(inputs, run.frame_ids[number]), config).items():
                file.write(data_block(f"{part}-{number}", value))
            tell(run.frame_ids[number])
        notes = _notes(inputs, len(detailed))
        file.write(data_block("frames", {"ids": list(run.frame_ids), "detailed": detailed}))
        file.write(
            data_block("cars", {"columns": list(rows[0]) if rows else [], "rows": [list(row.values()) for row in rows]})
        )
        file.write(data_block("run", _run_facts(run, rows, entries, notes)))
        file.write(foot)
    return ReportOutcome(page, page.stat().st_size, len(run.frame_ids), len(detailed), len(rows), tuple(notes))


def _notes(inputs: RunInputs, num_detailed: int) -> list[str]:
    """Notes about parts of the page that are missing or could not be used."""
    run, dataset, notes = inputs.run, inputs.dataset, list[str]()
    if left := read_status(run.path).num_left:
        notes.append(f"the run has not finished ({left} frames left): the page is of what is done")
    if dataset is None:
        notes.append("no pictures and no residual maps: the images were not given (--data)")
    if run.manifest.config.get("boxes") == "masks":
        notes.append("nothing from before the refinement: the boxes were made of masks")
    elif dataset is None or not inputs.has_detections:
        notes.append("nothing from before the refinement: the detections were not given (--detections)")
    if dataset is not None and dataset.masks is None:
        notes.append("no residual maps: the masks were not given (--masks)")
    if inputs.prior is None:
        notes.append("no residual maps and no shapes: the prior was not given (--prior)")
    if run.manifest.sha256["stereo_bias"] is not None and dataset is not None and not dataset.disparity_fields:
        notes.append("photometric residuals without the run's disparity field, so biased (--rig)")
    if num_detailed < len(run.frame_ids):
        notes.append(f"pictures and 3D views of {num_detailed} of {len(run.frame_ids)} frames (--max-frames)")
    found = sorted(inputs.problems.items())
    return notes + [f"{what} ({len(ids)} frame{'s' * (len(ids) != 1)})" for what, ids in found]


def _run_facts(
    run: RunFolder, rows: Sequence[CarRow], entries: Mapping[str, FrameEntry], notes: Sequence[str]
) -> dict[str, Any]:
    """The top of the page as JSON: counts, settings, mean errors, and notes about the page."""
    manifest, rigs, picture = run.manifest, _rigs(run), run.path / RIG_PICTURE
    drawn = data_url(read_rgb(picture)) if rigs and picture.is_file() else None
    return {
        "name": run.path.resolve().name,
        "package_version": manifest.package_version,
        "frames_done": len(run.frame_ids),
        "failed": dict(read_status(run.path).failed),
        "cars": len(rows),
        "refined": sum(row["refined"] for row in rows),
        "statuses": _statuses(rows),
        "ground_sources": dict(Counter(entry["ground_source"] for entry in entries.values())),
        "sha256": dict(manifest.sha256),
        "settings": {name: str(value) for name, value in sorted(flatten(manifest.config).items())},
        "errors": _mean_errors(rows),
        "notes": list(notes),
        "verdict": verdict(entries, rigs),
        "rig": {"words": [str(rig) for rig in rigs], "picture": drawn} if rigs else None,
    }


def _rigs(run: RunFolder) -> list[RigEstimate]:
    """The rigs in the run's folder, unless they are from an earlier run."""
    words, wanted = run.path / RIG_FILE, run.manifest.sha256["stereo_bias"]
    rigs = load_rigs(words) if wanted is not None and words.is_file() else []
    return rigs if rigs and hash_fields([rig.field for rig in rigs]) == wanted else []


def _statuses(rows: Sequence[CarRow]) -> list[dict[str, Any]]:
    """Name, number and meaning of each status that occurs, in the order of `Status`."""
    counts = Counter(row["status"] for row in rows)
    order = [name for name in Status.__members__ if name in counts]
    order += sorted(set(counts) - set(order))
    known = Status.__members__
    return [{"name": n, "count": counts[n], "meaning": known[n].value if n in known else ""} for n in order]


def _mean_errors(rows: Sequence[CarRow]) -> dict[str, Any] | None:
    """Mean errors over the cars that `directshape compare` counts, before and after over the same cars."""
    counted = [row for row in rows if row["counts"]]
    if not counted:
        return None
    names = ("centre_before_m", "centre_after_m", "yaw_before_deg", "yaw_after_deg", "iou_before", "iou_after")
    columns = {name: [row[name] for row in counted] for name in names}
    means = {name: None if None in values else statistics.fmean(values) for name, values in columns.items()}
    for side in ("before", "after"):
        overlaps = columns[f"iou_{side}"]
        means[f"share_over_0.7_{side}"] = None if None in overlaps else statistics.fmean(v > 0.7 for v in overlaps)
    pairs = [(row["iou_before"], row["iou_after"]) for row in counted]
    changes = [after - before for before, after in pairs if before is not None and after is not None]
    worse = sum(change < -WORSE_BY for change in changes) if changes else None
    return {"cars": len(counted), "worse": worse, "worse_by_iou": WORSE_BY, **means}
