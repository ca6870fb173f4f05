"""All checks over a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from directshape_torch.data_check.car_evidence import FrameEvidence, gather_evidence
from directshape_torch.data_check.check_box_2d import check_box_2d, check_corners
from directshape_torch.data_check.check_boxes import check_boxes
from directshape_torch.data_check.check_calibration import check_calibration
from directshape_torch.data_check.check_distances import DistanceRatios, check_distances, measure_distances
from directshape_torch.data_check.check_files import check_files
from directshape_torch.data_check.check_masks import check_masks
from directshape_torch.data_check.check_pair import FEW_MATCHES, check_mirrored, check_pair
from directshape_torch.data_check.check_rig import check_rig
from directshape_torch.data_check.check_times import check_times
from directshape_torch.data_check.finding import CheckReport, Finding, by_severity
from directshape_torch.data_check.frame_parts import FrameParts, read_parts
from directshape_torch.data_check.pair_matches import match_pair, mirror
from directshape_torch.errors import InputError
from directshape_torch.io.stereo_files import FileStereoDataset
from directshape_torch.scene import StereoCamera

DEFAULT_MAX_FRAMES = 20
# With these wrong, what disparities and projections show says nothing more.
_SPOILS_PAIR = frozenset(
    {"images_swapped", "image_mirrored", "same_image", "different_scenes", "not_rectified", "few_matches"}
)
_SPOILS_CAMERA = frozenset({"baseline_sign", "baseline_length", "focal_length"})


def check_dataset(
    dataset: FileStereoDataset,
    max_frames: int | None = DEFAULT_MAX_FRAMES,
    tell: Callable[[str], None] = lambda _: None,
) -> CheckReport:
    """Look for everything that is commonly wrong with a data set.

    Args:
        dataset: of any layout.
        max_frames: frames whose content is read, spread evenly; None: all. That files exist is asked of every frame.
        tell: called after each frame that was read.

    Raises:
        InputError: `max_frames` below 1.
    """
    if max_frames is not None and max_frames < 1:
        raise InputError("max_frames", "at least 1", str(max_frames))
    chosen = spread(dataset.frame_ids, max_frames)
    findings = [*check_files(dataset), *check_times(dataset, dataset.frame_ids)]
    seen = _Seen()
    for frame_id in chosen:
        findings += _check_frame(dataset, frame_id, seen)
        tell(frame_id)
    of_cars = _check_cars(seen)
    # Of boxes or images that are wrong an estimate would only say the same again.
    if not any(finding.severity == "error" for finding in (*findings, *of_cars)):
        of_cars += check_rig(dataset, chosen)
    findings += of_cars
    return CheckReport(by_severity(findings), len(dataset), len(chosen), seen.num_cars)


def spread(frame_ids: Sequence[str], count: int | None) -> tuple[str, ...]:
    """At most `count` of the frames, evenly spread, the first among them.

    Example:
        >>> spread("abcdefgh", 3)
        ('a', 'c', 'f')
    """
    if count is None or count >= len(frame_ids):
        return tuple(frame_ids)
    return tuple(frame_ids[index * len(frame_ids) // count] for index in range(count))


@dataclass
class _Seen:
    """What the frames have shown so far."""

    evidence: list[FrameEvidence] = field(default_factory=list)
    ratios: list[DistanceRatios] = field(default_factory=list)
    num_cars: int = 0


def _check_frame(dataset: FileStereoDataset, frame_id: str, seen: _Seen) -> list[Finding]:
    parts, findings = read_parts(dataset, frame_id)
    where = f"frame {frame_id}"
    if parts.calibration is not None:
        findings += check_calibration(parts.calibration, parts.size_hw, where)
    # A wrong calibration must not spoil what the images say by themselves.
    usable = not _names(findings) & _SPOILS_CAMERA
    findings += _check_pair(parts, parts.camera if usable else None, where)
    seen.num_cars += len(parts.objects)
    evidence = gather_evidence(parts)
    if evidence is not None and usable:
        seen.evidence.append(evidence)
        if not _names(findings) & _SPOILS_PAIR and parts.left is not None and parts.right is not None:
            seen.ratios.append(measure_distances(evidence, parts.left, parts.right))
    return findings


def _check_pair(parts: FrameParts, camera: StereoCamera | None, where: str) -> list[Finding]:
    if parts.left is None or parts.right is None or parts.size_hw is None:
        return []
    matches = match_pair(parts.left, parts.right)
    if len(matches) < FEW_MATCHES:
        mirrored = check_mirrored(matches, match_pair(parts.left, mirror(parts.right)), where)
        if mirrored:
            return mirrored
    return check_pair(matches, camera, parts.size_hw, where)


def _check_cars(seen: _Seen) -> list[Finding]:
    """Boxes, masks and distances; each is asked only where what it rests on was found right."""
    if not seen.num_cars:
        return [_no_cars()]
    of_boxes = check_box_2d(seen.evidence) or check_boxes(seen.evidence)
    if any(finding.severity == "error" for finding in of_boxes):
        # Masks are found by the boxes and distances are those of the boxes, so they would only say the same again.
        explained = _names(of_boxes) != {"box_projection"}
        of_masks = check_masks(seen.evidence)
        return [*of_boxes, *(found for found in of_masks if found.check != "masks_elsewhere" or not explained)]
    found = [*of_boxes, *check_corners(seen.evidence), *check_masks(seen.evidence)]
    return found + check_distances(seen.ratios)


def _no_cars() -> Finding:
    return Finding(
        "no_cars",
        "error",
        "all frames",
        "no detection of the chosen classes with a 3D box",
        "lines of class Car (or --classes) with positive h w l and a location",
        "check names of classes and the folder of detections",
    )


def _names(findings: Sequence[Finding]) -> set[str]:
    return {finding.check for finding in findings if finding.severity != "warning"}
