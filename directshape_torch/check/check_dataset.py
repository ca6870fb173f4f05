"""This module runs all checks over a data set."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from directshape_torch.check.check_scene import check_cars
from directshape_torch.check.finding import CheckReport, Finding, by_severity
from directshape_torch.check.mistakes import found, words_of_files
from directshape_torch.check.read_frame import read_frame
from directshape_torch.errors import DataFormatError, DirectShapeError, InputError
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.rigs import rig_among

REPORT_SCHEMA_VERSION = 1
_NAMED = 3
# An offset of 0.15 px is 0.35 m at 30 m on KITTI's rig.
LARGEST_OFFSET_PX, LARGEST_BIAS = 0.15, 0.03
_SURE = 2.0  # standard deviations
_FEWEST_CARS = 10  # with fewer cars the noise of a detector is not known


def check_dataset(
    dataset: StereoDataset, max_frames: int = 20, tell: Callable[[str], object] = lambda _: None
) -> CheckReport:
    """Check a data set for common mistakes.

    Args:
        dataset: data set of any layout.
        max_frames: largest number of frames whose content is read, evenly spread. The existence of files is checked
            for all frames.
        tell: function that is called after each frame that was read.

    Raises:
        InputError: `max_frames` is below 1.
    """
    if max_frames < 1:
        raise InputError("max_frames", "at least 1", str(max_frames))
    number = min(max_frames, len(dataset))
    chosen = [dataset.frame_ids[index * len(dataset) // number] for index in range(number)]
    findings, num_cars = check_frames(dataset, chosen, tell)
    findings = [*_check_files(dataset), *findings]
    # If boxes or images are wrong, the estimate of the rig would only report the same mistake again.
    if not any(finding.severity == "error" for finding in findings):
        findings += check_rig(dataset, chosen)
    return CheckReport(by_severity(findings), len(dataset), len(chosen), num_cars)


def check_frames(
    dataset: StereoDataset,
    frame_ids: Sequence[str],
    tell: Callable[[str], object] = lambda _: None,
    match_images: bool = True,
) -> tuple[list[Finding], int]:
    """Findings about frames, one by one and together, and the number of their cars.

    Args:
        dataset, tell: see `check_dataset`.
        frame_ids: frames to check.
        match_images: whether features of both images are matched, which takes most of the time.
    """
    findings, evidence, num_cars = list[Finding](), [], 0
    for frame_id in frame_ids:
        of_frame, count, of_its_cars = read_frame(dataset, frame_id, match_images)
        findings += of_frame
        evidence += [] if of_its_cars is None else [of_its_cars]
        num_cars += count
        tell(frame_id)
    words = words_of_files(dataset.layout.files(dataset.frame_ids[0]).calibration)
    nothing = "no detection of the chosen classes with a 3D box"
    if not dataset.has_detections:
        nothing, num_cars = "no mask of a car in the left images", sum(one.num_masks["left"] for one in evidence)
    of_cars = check_cars(evidence) if num_cars else [found("no_cars", "all frames", nothing, words)]
    return [*findings, *of_cars], num_cars


def _check_files(dataset: StereoDataset) -> list[Finding]:
    """One finding for each kind of missing file in all frames; only the existence of files is checked."""
    missing: dict[str, list[str]] = {}
    for frame_id in dataset.frame_ids:
        for role, path in _files(dataset, frame_id):
            if not path.is_file():
                missing.setdefault(role, []).append(str(path))
    findings = []
    for role, paths in missing.items():
        more = f" and {len(paths) - _NAMED} more" if len(paths) > _NAMED else ""
        measured = f"no {role.replace('_', ' ')}: {', '.join(paths[:_NAMED])}{more}"
        findings.append(found("missing_files", f"{len(paths)} of {len(dataset)} frames", measured))
    return findings


def _files(dataset: StereoDataset, frame_id: str) -> Iterable[tuple[str, Path]]:
    try:
        return [(role.rstrip("_0123456789"), path) for role, path in dataset.input_files(frame_id).items()]
    except DataFormatError as error:
        # A file that lists other files is missing or damaged, which is found when the frame is read.
        files = dataset.layout.files(frame_id)
        return [("image_left", files.left), ("image_right", files.right), ("list of masks", error.path)]


def report_content(report: CheckReport) -> dict[str, Any]:
    """A report as JSON values (schema 1)."""
    return {
        "schema_version": REPORT_SCHEMA_VERSION,
        "frames": report.num_frames,
        "checked_frames": report.num_checked,
        "cars": report.num_cars,
        "findings": [asdict(finding) for finding in report.findings],
    }


def check_rig(dataset: StereoDataset, frame_ids: Sequence[str]) -> list[Finding]:
    """Findings about the errors of rigs, estimated from detections, beyond the disparity fields of the data set."""
    plain, rigs = replace(dataset, ground="camera_height", disparity_fields=()), list[RigEstimate]()
    for frame_id in frame_ids:
        # Unreadable files have been reported before.
        with suppress(DirectShapeError, OSError):
            loaded = plain.load(frame_id)
            rig_among(rigs, Rig.of_frame(loaded.frame)).update(loaded.frame, loaded.detections)
    enough = [rig for rig in rigs if len(rig.rows) >= _FEWEST_CARS]
    return [finding for rig in enough for finding in (*_offset(rig, dataset), *_bias(rig))]


def _offset(rig: RigEstimate, dataset: StereoDataset) -> list[Finding]:
    place = rig.rows[:, :2].median(dim=0).values
    offset, sigma = (float(x) for x in rig.offset_at(place))
    known = sum(float(field.bias(place)) for field in dataset.disparity_fields if rig.is_of(*field.rig))
    rest = offset - known
    if abs(rest) < max(LARGEST_OFFSET_PX, _SURE * sigma):
        return []
    measured = (
        f"disparities differ from those of the boxes by {rest:+.2f} +- {sigma:.2f} px in the middle of the cars, "
        f"{abs(rest) * rig.metres_per_pixel(30.0):.1f} m at 30 m"
    )
    return [found("rig_offset", f"{len(rig.rows)} cars", measured, limit=LARGEST_OFFSET_PX)]


def _bias(rig: RigEstimate) -> list[Finding]:
    detector = rig.detector
    if abs(detector.bias) < max(LARGEST_BIAS, _SURE * detector.bias_sigma):
        return []
    side = "near" if detector.bias < 0 else "far"
    measured = f"boxes stand {abs(detector.bias):.1%} +- {detector.bias_sigma:.1%} too {side}".replace("%", " %")
    limit = f"{LARGEST_BIAS:.0%}".replace("%", " %")
    return [found("detector_bias", f"{detector.num_cars} cars", measured, limit=limit)]
