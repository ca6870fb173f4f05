"""This module has findings about data, their report, and a table of common mistakes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from directshape_torch.check.words import Says, Words

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """A `Finding` is the measurement of a check with its cure.

    Attributes:
        check: name of the check in the table of docs/check_data.md.
        severity: "error" spoils results; "warning" may; "note" names what could not be checked.
        where: a frame, a file, or "all frames".
        measured: measurement, with numbers.
        expected: expected value.
        cure: how to correct the data.
        places: if the finding stands for several of its kind, the `where` of each, in order; else empty.
    """

    check: str
    severity: Severity
    where: str
    measured: str
    expected: str
    cure: str
    places: tuple[str, ...] = ()

    def __str__(self) -> str:
        """The finding in one line."""
        return f"{self.severity}: {self.check} ({self.where}): {self.measured}; expected {self.expected}; {self.cure}"

    def block(self) -> str:
        """The finding in four lines."""
        return (
            f"{self.severity}: {self.check} ({self.where})\n"
            f"  measured  {self.measured}\n"
            f"  expected  {self.expected}\n"
            f"  cure      {self.cure}\n"
        )


def unreadable(check: str, where: str, expected: str, error: Exception, cure: str) -> Finding:
    """A finding about an unusable file with the text of its error, and with `cure` if the error has none."""
    measured, _, own_cure = " ".join(str(error).split()).partition("; ")
    return Finding(check, "error", where, measured, expected, own_cure or cure)


@dataclass(frozen=True)
class CheckReport:
    """A `CheckReport` has all findings about a data set.

    Attributes:
        findings: findings, errors first.
        num_frames: number of frames of the data set.
        num_checked: number of frames whose content was read.
        num_cars: number of detections of the refined classes in these frames.
    """

    findings: tuple[Finding, ...]
    num_frames: int
    num_checked: int
    num_cars: int

    def count(self, severity: Severity) -> int:
        """Number of findings of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    def __str__(self) -> str:
        """The report as one block for each finding, and a last line with counts."""
        counts = ", ".join(f"{n} {name}{'' if n == 1 else 's'}" for name in SEVERITIES for n in [self.count(name)])
        of = "" if self.num_checked == self.num_frames else f" of {self.num_frames}"
        last = f"{counts} in {self.num_checked}{of} frames with {self.num_cars} cars"
        return "\n".join([*(finding.block() for finding in self.findings), last])

    @property
    def exit_code(self) -> int:
        """1 with errors, else 0."""
        return 1 if self.count("error") else 0


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then notes, in their order; findings of one kind about single frames are merged."""
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        kind = ("frame",) if finding.where.split()[0:1] == ["frame"] else (finding.where, finding.measured)
        groups.setdefault((finding.severity, finding.check, *kind), []).append(finding)
    return tuple(sorted(map(_merged, groups.values()), key=lambda finding: SEVERITIES.index(finding.severity)))


def _merged(findings: Sequence[Finding]) -> Finding:
    """The first finding with the places of all."""
    first = findings[0]
    if len(findings) == 1:
        return first
    places = tuple(finding.where for finding in findings)
    return replace(first, where=f"{first.where} and {len(findings) - 1} more", places=places)


def names(findings: Iterable[Finding]) -> set[str]:
    """Names of the checks with findings other than warnings."""
    return {finding.check for finding in findings if finding.severity != "warning"}


SAID_BY_THE_RUN = frozenset(
    {"left_image", "right_image", "image_size", "calibration_file", "detection_file", "mask_file", "mask_size"}
    | {"plane_file", "lidar_file", "no_cars"}
)
"""The run itself reports these findings about files, for each frame."""


class Mistake(NamedTuple):
    """A `Mistake` is a kind of mistake, with fields in braces for `str.format`.

    Kinds without texts here have them in `Words`, because their cure depends on the source of data.
    """

    severity: Severity
    expected: str = ""
    cure: str = ""


MISTAKES: dict[str, Mistake] = {
    "focal_length": Mistake(
        "error",
        "the same within 5 percent, as rectified images have",
        "scale fx, cx with the width and fy, cy with the height of resized images",
    ),
    "raw_intrinsics": Mistake(
        "error",
        "the intrinsics of the rectified images: one focal length and one row of the centre for both",
        "give K = P[:, :3] of the rectified cameras, not K of the raw ones (a ROS camera_info has both, OpenCV's "
        "stereoRectify returns P1 and P2), and the baseline -P_right[0, 3] / P_right[0, 0]",
    ),
    "principal_point": Mistake(
        "warning",
        "near the middle of the image",
        "use the intrinsics of this size of image; cutting moves the point, resizing scales it",
    ),
    "baseline_sign": Mistake("error"),
    "baseline_length": Mistake("error"),
    "images_swapped": Mistake(
        "error",
        "disparities u_left - u_right above 0: everything lies farther left in the right image",
        "swap the left and the right images (or were they mirrored?)",
    ),
    "image_mirrored": Mistake(
        "error", "two images of the same sense", "mirror the one that is read in the wrong direction"
    ),
    "same_image": Mistake(
        "error", "disparity between the two images", "give the right camera's images, not copies of the left ones"
    ),
    "different_scenes": Mistake(
        "error",
        "at least {share:.0%} of them",
        "check that left and right file of a frame carry the same name, and that neither is mirrored",
    ),
    "not_rectified": Mistake(
        "error",
        "within {limit} px of what the calibration says",
        "rectify the pair (cv2.stereoRectify and initUndistortRectifyMap) with the calibration that is given",
    ),
    "not_synchronous": Mistake(
        "warning", "at most {limit} px", "give images taken at the same moment, with lens distortion removed"
    ),
    "few_matches": Mistake(
        "note", "at least {limit}", "nothing, where the images have little texture; the pair was not checked"
    ),
    "grey_levels": Mistake(
        "warning", "photographs of 0 to 255, alike on both sides", "expose and convert both cameras alike"
    ),
    "mask_size": Mistake(
        "error",
        "masks of the size of their image",
        "resize the masks to the size of the images, not the images to that of the masks",
    ),
    "masks_elsewhere": Mistake(
        "error",
        "at least {limit}",
        "check that masks and detections are of the same frames and the same size of image, and that 2D boxes are "
        "u_min v_min u_max v_max",
    ),
    "masks_swapped": Mistake(
        "error",
        "left boxes that fit left masks, and cars farther left in the right image",
        "swap the two sides of the masks (or detections and masks were made on the right image)",
    ),
    "no_masks": Mistake("error"),
    "box_2d": Mistake("error", "u_min v_min u_max v_max, pixels", "add x to the width and y to the height"),
    "box_axes": Mistake("error"),
    "box_origin": Mistake("error"),
    "box_yaw": Mistake("error"),
    "box_order": Mistake("error"),
    "box_units": Mistake("error"),
    "box_projection": Mistake("error"),
    "missing_files": Mistake(
        "error", "every frame to have all of its files", "add them, or leave the frames out with --split or --frames"
    ),
    "no_cars": Mistake("error"),
    "rig_offset": Mistake(
        "warning",
        "within {limit} px",
        "nothing for 'directshape refine', which estimates it (--rig auto); for more evidence: 'calibrate-rig'",
    ),
    "detector_bias": Mistake(
        "warning",
        "within {limit}",
        "check focal length and baseline, or the detector's training; 'directshape refine' goes by the images",
    ),
    "lidar_elsewhere": Mistake(
        "error",
        "at least {limit}",
        "no known way to read the scans fits: check that scan and images are of the same frame, and Tr_velo_to_cam",
    ),
    "distance_scale": Mistake("error", "within {limit:.0%}", "check focal length, baseline and the units of the boxes"),
}


def of_cars(count: int) -> str:
    """The place of a finding about all cars."""
    return f"all frames, {count} cars"


def found(
    check: str,
    where: str,
    measured: str,
    *,
    words: Words | None = None,
    severity: Severity | None = None,
    expected: str = "",
    cure: str = "",
    **numbers: float | str,
) -> Finding:
    """A finding with the texts of the table or of its source, unless other texts are given."""
    kind = MISTAKES[check]
    own = {} if words is None else words.says
    says = Says(kind.expected, kind.cure) if kind.expected else own[check]
    return Finding(
        check,
        severity or kind.severity,
        where,
        measured,
        expected or says.expected.format(**numbers),
        cure or says.cure,
    )
