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
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(args, name) is not None]
    if given:
        raise InputError("--data", f"the data set of the run, because of {', '.join(given)}", "nothing")


def field_of_run(path: Path, manifest: RunManifest) -> DisparityField:
    """The disparity field in a file, if a run was made with it.

    Raises:
        DataFormatError: the file holds no field.
        InputError: the run was made with another one, or with none.
    """
    from directshape_torch.batch.content_hashes import hash_field
    from directshape_torch.geometry.disparity_field import DisparityField

    field = DisparityField.load(path)
    if hash_field(field) != manifest.sha256.get("stereo_bias"):
        raise InputError("--stereo-bias", "the field that the run was made with", f"another one in {path}")
    return field
