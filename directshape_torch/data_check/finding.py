"""One thing that is wrong, or looks wrong, with a data set."""

from __future__ import annotations

from collections.abc import Iterable
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

    @property
    def exit_code(self) -> int:
        """1 with errors, else 0."""
        return 1 if self.count("error") else 0


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then notes; else in their order.

    Example:
        >>> note, error = (Finding("a", severity, "", "", "", "") for severity in ("note", "error"))
        >>> [finding.severity for finding in by_severity([note, error])]
        ['error', 'note']
    """
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))
