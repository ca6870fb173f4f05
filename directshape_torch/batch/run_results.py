"""What stands in an output folder: its summary, and the frames that only the journals know yet."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from directshape_torch.batch.journal import FrameRecord, read_journals
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.run_manifest import RunManifest, read_manifest


def summary_path(out_dir: Path) -> Path:
    """The summary of an output folder."""
    return out_dir / "summary.json"


def read_run_results(out_dir: Path) -> RunManifest:
    """`summary.json` of a run with all its frames, while it goes on and after it was cut off too.

    Raises:
        DataFormatError: the folder holds no `summary.json`, or a damaged one.
    """
    # Before the summary: a journal that goes in between was taken into it.
    records = read_journals(out_dir).records
    path = summary_path(out_dir)
    manifest = read_manifest(path)
    if manifest is None:
        raise DataFormatError(path, "is missing", cure="give the folder of --out of 'directshape refine'")
    for record in records:
        add_record(manifest, record)
    return manifest


def add_record(manifest: RunManifest, record: FrameRecord) -> None:
    """Note in a manifest how a frame ended; outputs of an earlier run that are still valid stay listed."""
    earlier, entry = manifest.frames.get(record.frame_id, {}), record.entry
    if manifest.is_done(record.frame_id):
        # What is finished stays finished, whatever a clock says of the order.
        if entry["state"] == "failed":
            return
        lists = ("outputs", "mesh_files")
        entry = {**entry, **{name: sorted({*earlier.get(name, ()), *entry.get(name, ())}) for name in lists}}
        entry["files"] = {**earlier.get("files", {}), **entry.get("files", {})}
    manifest.inputs[record.frame_id] = record.inputs
    manifest.frames[record.frame_id] = entry


def finished_frames(out_dir: Path, manifest: RunManifest, wanted: Iterable[str | int] | None = None) -> list[str]:
    """The frames that a run has refined, in order.

    Args:
        out_dir: the folder, for messages.
        manifest: of `read_run_results`.
        wanted: only these, by id, or by number with leading zeros or without; None: all.

    Raises:
        InputError: one of these is not finished.
    """
    done = sorted(name for name in manifest.frames if manifest.is_done(name))
    if wanted is None:
        return done
    # The ids after the numbers, so that they win.
    known = {_number(name): name for name in done} | {name: name for name in done}
    words = [str(one) for one in wanted]
    missing = [word for word in words if word not in known and _number(word) not in known]
    if missing:
        raise InputError("frames", f"finished frames of {out_dir}", ", ".join(missing[:5]))
    return sorted({known[word] if word in known else known[_number(word)] for word in words})


def _number(word: str) -> str:
    """A number without leading zeros; other names as they are."""
    return word.lstrip("0") or "0" if word.isdecimal() else word
