"""A report of findings for people and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from directshape_torch.data_check.finding import SEVERITIES, CheckReport, Finding
from directshape_torch.files.atomic_files import write_json

REPORT_SCHEMA_VERSION = 1


def format_report(report: CheckReport) -> str:
    """One block a finding, of findings about single frames one a kind with the first in full, and a last line."""
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for finding in report.findings:
        frames = finding.where.split()[0]
        kind = ("frame",) if frames == "frame" else (finding.where, finding.measured)
        groups.setdefault((finding.severity, finding.check, *kind), []).append(finding)
    blocks = [_block(findings) for findings in groups.values()]
    return "\n".join([*blocks, _last_line(report)]) + "\n"


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


def report_content(report: CheckReport) -> dict[str, Any]:
    """What the JSON file holds (schema 1)."""
    return {
        "schema_version": REPORT_SCHEMA_VERSION,
        "frames": report.num_frames,
        "checked_frames": report.num_checked,
        "cars": report.num_cars,
        "findings": [asdict(finding) for finding in report.findings],
    }


def write_report(path: Path, report: CheckReport) -> None:
    """Write it."""
    write_json(path, report_content(report))
