"""What the commands that look at a finished run ask of its inputs when they are named again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.errors import InputError

if TYPE_CHECKING:
    from directshape_torch.geometry.disparity_field import DisparityField
    from directshape_torch.io.run_manifest import RunManifest


def check_data_is_not_needed(args: argparse.Namespace, *names: str) -> None:
    """Refuse options that say nothing without `--data`.

    Args:
        args: without `data`.
        names: of these options in `args`.

    Raises:
        InputError: one is given.
    """
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(args, name) not in (None, "none")]
    if given:
        raise InputError("--data", f"the data set of the run, because of {', '.join(given)}", "nothing")


def fields_of_run(rig: str, out_dir: Path, manifest: RunManifest) -> tuple[DisparityField, ...]:
    """The disparity fields that a run was made with: those of its own folder, or of the file that `--rig` names.

    Raises:
        DataFormatError: the file holds none.
        InputError: the run was made with others, or with none.
    """
    from directshape_torch.batch.content_hashes import hash_fields
    from directshape_torch.rig.rig_file import RIG_FILE, load_fields

    own = out_dir / RIG_FILE
    if rig == "none" and not own.is_file():
        return ()
    path = own if rig == "none" else Path(rig)
    fields = load_fields(path)
    if hash_fields(fields) != manifest.sha256.get("stereo_bias"):
        raise InputError("--rig", "the disparity fields that the run was made with", f"others in {path}")
    return fields
