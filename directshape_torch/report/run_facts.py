"""What the top of the page says about a run: counts, settings, and what the page lacks and why."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from directshape_torch.evaluation.comparison import WORSE_BY_BEV_IOU
from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.run_manifest import flatten, hash_fields
from directshape_torch.report.car_rows import CarRow
from directshape_torch.report.page_parts import data_url
from directshape_torch.rig.rig_file import RIG_FILE, RIG_PICTURE, load_rigs
from directshape_torch.status import Status


def run_facts(
    run: RunFolder,
    rows: Sequence[CarRow],  # of all cars
    grounds: Mapping[str, int],  # number of frames by the source of their ground plane
    notes: Sequence[str],  # what the reader should know about this page
) -> dict[str, Any]:
    """The facts as JSON."""
    manifest = run.manifest
    return {
        "name": run.path.resolve().name,
        "package_version": manifest.package_version,
        "frames_done": len(run.frame_ids),
        "failed": {name: why for name, why in manifest.failed.items() if name not in run.frame_ids},
        "cars": len(rows),
        "refined": sum(row.refined for row in rows),
        "statuses": _statuses(rows),
        "ground_sources": dict(grounds),
        "sha256": dict(manifest.sha256),
        "settings": {name: str(value) for name, value in sorted(flatten(manifest.config).items())},
        "errors": _mean_errors(rows),
        "notes": list(notes),
        "rig": _rig(run),
    }


def _rig(run: RunFolder) -> dict[str, Any] | None:
    """What the run estimated of its rigs, in words and as a picture; None where it did not."""
    words, picture, wanted = run.path / RIG_FILE, run.path / RIG_PICTURE, run.manifest.sha256["stereo_bias"]
    if wanted is None or not words.is_file():
        return None
    rigs = load_rigs(words)
    if hash_fields([rig.field for rig in rigs]) != wanted:  # an earlier run's
        return None
    return {"words": [str(rig) for rig in rigs], "picture": data_url(read_rgb(picture)) if picture.is_file() else None}


def _statuses(rows: Sequence[CarRow]) -> list[dict[str, Any]]:
    """Name, number and meaning of each status that occurs, in the order of `Status`."""
    counts = Counter(row.status for row in rows)
    order = [name for name in Status.__members__ if name in counts]
    order += sorted(set(counts) - set(order))
    known = Status.__members__
    return [{"name": n, "count": counts[n], "meaning": known[n].value if n in known else ""} for n in order]


def _mean_errors(rows: Sequence[CarRow]) -> dict[str, Any] | None:
    """Mean errors over the cars that `directshape compare` counts; before and after over the same cars."""
    counted = [row for row in rows if row.counts]
    if not counted:
        return None
    names = ("centre_before_m", "centre_after_m", "yaw_before_deg", "yaw_after_deg", "iou_before", "iou_after")
    columns = {name: [getattr(row, name) for row in counted] for name in names}
    means = {name: None if None in values else statistics.fmean(values) for name, values in columns.items()}
    for side in ("before", "after"):
        overlaps = columns[f"iou_{side}"]
        means[f"share_over_0.7_{side}"] = None if None in overlaps else statistics.fmean(v > 0.7 for v in overlaps)
    changes = [
        row.iou_after - row.iou_before for row in counted if row.iou_before is not None and row.iou_after is not None
    ]
    worse = sum(change < -WORSE_BY_BEV_IOU for change in changes) if changes else None
    return {"cars": len(counted), "worse": worse, "worse_by_iou": WORSE_BY_BEV_IOU, **means}
