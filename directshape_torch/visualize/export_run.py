"""`export_run` writes a finished run in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import check_folder
from directshape_torch.visualize.rerun_recording import recording
from directshape_torch.visualize.run_frames import RunFrame, RunInputs
from directshape_torch.visualize.surface_files import write_glb, write_ply

_WRITERS: dict[str, Callable[[Path, RunFrame], None]] = {"glb": write_glb, "ply": write_ply}
FORMATS = (*_WRITERS, "rerun")
"""These are the formats of `export_run` (docs/outputs.md)."""


def export_run(
    inputs: RunInputs,
    folder: Path | str,
    formats: Sequence[str],
    tell: Callable[[str], object] = lambda _: None,
) -> None:
    """Write the finished frames of a run in other formats (docs/outputs.md). The run itself is only read.

    Args:
        inputs: chosen frames of an output folder, shape prior, and the images for colours.
        folder: folder of `glb`, `ply` and `recording.rrd`; existing files with the same names are replaced.
        formats: names out of `FORMATS`.
        tell: function that is called after each frame.

    Raises:
        MissingDependencyError: "rerun" is chosen without Rerun.
        InputError: a format is unknown, or needs images which were not given.
        DataFormatError: a file of the run or of the data set is missing, damaged or not that of the run.
    """
    run = inputs.run
    check_folder("out", Path(folder))
    if not run.frame_ids:
        raise InputError("frames", f"finished frames of {run.path}", "none")
    if unknown := [name for name in formats if name not in FORMATS]:
        raise InputError("formats", f"of {', '.join(FORMATS)}", repr(unknown[0]))
    folder, wanted = Path(folder), dict.fromkeys(formats)
    writers: list[Callable[[RunFrame], object]] = [
        partial(_WRITERS[name], folder) for name in wanted if name in _WRITERS
    ]
    with ExitStack() as stack:
        if "rerun" in wanted:
            writers.append(stack.enter_context(recording(folder / "recording.rrd", inputs)))
        for frame_id in run.frame_ids:
            # All writers of a frame share what is read and computed.
            frame = RunFrame(inputs, frame_id)
            for write in writers:
                write(frame)
            tell(frame_id)
