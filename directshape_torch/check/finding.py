"""This module has findings about data and their report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

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
