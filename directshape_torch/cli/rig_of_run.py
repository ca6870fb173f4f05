"""`refine --rig auto`: the run's own estimate of its rigs, made once and kept in its folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from directshape_torch.io.stereo_files import FileStereoDataset
    from directshape_torch.rig.estimate import RigEstimate


def rigs_of_run(dataset: FileStereoDataset, rig: str, out_dir: Path, fresh: bool) -> list[RigEstimate]:
    """The estimates that `--rig` names: those of a file, or of the run's folder, made first where there are none yet.

    Raises:
        DataFormatError: the folder has a file of that name which is no estimate.
    """
    from directshape_torch.rig.rig_file import RIG_FILE, holds_rigs, load_rigs, save_rigs

    if rig != "auto":
        return load_rigs(rig) if rig != "none" and holds_rigs(rig) else []
    path = out_dir / RIG_FILE
    # Whatever lies there is not overwritten, unless it is an estimate.
    kept = load_rigs(path) if path.is_file() else None
    rigs = _estimate(dataset) if kept is None or fresh else kept
    if rigs is not kept:
        save_rigs(path, rigs)
        write_rig_picture(out_dir, rigs)
    for estimate in rigs:
        print(estimate if rigs is not kept else f"{estimate} (kept)")
    return rigs


def _estimate(dataset: FileStereoDataset) -> list[RigEstimate]:
    from directshape_torch.cli.progress import Bar
    from directshape_torch.rig.of_dataset import estimate_rigs

    with Bar(desc="rig", unit="frame", file=sys.stderr) as bar:
        return estimate_rigs(dataset, lambda _: bar.update())


def write_rig_picture(out_dir: Path, rigs: list[RigEstimate]) -> None:
    """`rig.png`: each field with the cars that it was estimated from."""
    from directshape_torch.files.atomic_files import write_png
    from directshape_torch.rig.rig_file import RIG_PICTURE
    from directshape_torch.visualize.rig_picture import draw_rigs

    if rigs:
        write_png(out_dir / RIG_PICTURE, draw_rigs(rigs))
