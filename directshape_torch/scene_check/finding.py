"""One thing that is wrong, or looks wrong, with a data set."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """What a check measured, and what to do about it.

    Attributes:
        check: its name in the table of docs/check_data.md.
        severity: "error" spoils results; "warning" may; "note" says what could not be checked.
        where: a frame, a file, or "all frames".
        measured: what was found, with numbers.
        expected: what it should have been.
        cure: how to mend it.
    """

    check: str
    severity: Severity
    where: str
    measured: str
    expected: str
    cure: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.severity}: {self.check} ({self.where}): {self.measured}; expected {self.expected}; {self.cure}"


def unreadable(check: str, where: str, expected: str, error: Exception, cure: str) -> Finding:
    """A file that cannot be used, in the words of its error, which ends with a cure of its own or is given one.

    Examples:
        >>> unreadable("mask_file", "frame 1", "a list", ValueError("a.json: is empty; write it"), "?").cure
        'write it'
    """
    measured, _, own_cure = " ".join(str(error).split()).partition("; ")
    return Finding(check, "error", where, measured, expected, own_cure or cure)


@dataclass(frozen=True)
class CheckReport:
    """All findings about a data set.

    Attributes:
        findings: errors first.
        num_frames: frames of the data set.
        num_checked: frames whose content was read.
        num_cars: detections of the refined classes in these.
    """

    findings: tuple[Finding, ...]
    num_frames: int
    num_checked: int
    num_cars: int

    def count(self, severity: Severity) -> int:
        """How many findings there are of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    def __str__(self) -> str:
        """One block a finding, of findings about single frames one a kind with the first in full, and a last line."""
        return _text(self)

    @property
    def exit_code(self) -> int:
        """1 with errors, else 0."""
        return 1 if self.count("error") else 0


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then notes; else in their order.

    Examples:
        >>> note, error = (Finding("a", severity, "", "", "", "") for severity in ("note", "error"))
        >>> [finding.severity for finding in by_severity([note, error])]
        ['error', 'note']
    """
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def names(findings: Iterable[Finding]) -> set[str]:
    """The checks that found more than a warning."""
    return {finding.check for finding in findings if finding.severity != "warning"}


def _text(report: CheckReport) -> str:
    """One block a finding, of findings about single frames one a kind with the first in full, and a last line."""
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for finding in report.findings:
        frames = finding.where.split()[0]
        kind = ("frame",) if frames == "frame" else (finding.where, finding.measured)
        groups.setdefault((finding.severity, finding.check, *kind), []).append(finding)
    blocks = [_block(findings) for findings in groups.values()]
    return "\n".join([*blocks, _last_line(report)])


def _block(findings: Sequence[Finding]) -> str:
    first = findings[0]
    more = f" and {len(findings) - 1} more" if len(findings) > 1 else ""
    return (
        f"{first.severity}: {first.check} ({first.where}{more})\n"
        f"  measured  {first.measured}\n"
        f"  expected  {first.expected}\n"
        f"  cure      {first.cure}\n"
    )


def _last_line(report: CheckReport) -> str:
    words = [
        f"{report.count(severity)} {severity}{'' if report.count(severity) == 1 else 's'}" for severity in SEVERITIES
    ]
    of = "" if report.num_checked == report.num_frames else f" of {report.num_frames}"
    return f"{', '.join(words)} in {report.num_checked}{of} frames with {report.num_cars} cars"
