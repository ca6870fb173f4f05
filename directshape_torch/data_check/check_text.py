"""A report of findings for programs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from directshape_torch.files.atomic_files import write_json
from directshape_torch.scene_check.finding import CheckReport

REPORT_SCHEMA_VERSION = 1


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
