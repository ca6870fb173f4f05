"""What stands in an output folder: its summary, and the frames that only the journals know yet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from directshape_torch.batch.journal import read_journals
from directshape_torch.errors import DataFormatError
from directshape_torch.io.run_manifest import RunManifest, read_manifest


def read_run_results(out_dir: Path) -> RunManifest:
    """`summary.json` of a run with all its frames, while it goes on and after it was cut off too.

    Raises:
        DataFormatError: the folder holds no `summary.json`, or a damaged one.
    """
    path = out_dir / "summary.json"
    manifest = read_manifest(path)
    if manifest is None:
        raise DataFormatError(path, "is missing", cure="give the folder of --out of 'directshape refine'")
    frames, inputs = dict(manifest.frames), dict(manifest.inputs)
    for record in read_journals(out_dir).records:
        frames[record.frame_id], inputs[record.frame_id] = record.entry, record.inputs
    return replace(manifest, frames=frames, inputs=inputs)
