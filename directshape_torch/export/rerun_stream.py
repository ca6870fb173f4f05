"""A Rerun recording that is under way: its file, its timelines, and how the viewer opens it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from directshape_torch.errors import MissingDependencyError

FRAME, ITERATION = "frame", "iteration"
"""The timelines: numbers of frames; iterations of all frames, one after another."""


def import_rerun() -> Any:
    """The package `rerun`.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise MissingDependencyError("rerun-sdk", "viewer", "a Rerun recording") from error
    return rerun


class RerunStream:
    """Writes a recording beside its place, and moves it there when it is whole.

    Args:
        path: of the .rrd file; its folder is made where it is missing.
        with_iterations: whether there is a timeline of iterations to look at.

    Raises:
        MissingDependencyError: Rerun is not installed.
    """

    def __init__(self, path: Path, with_iterations: bool = False) -> None:
        self.rr, self.path = import_rerun(), path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = self.rr.RecordingStream("directshape", send_properties=False)
        self._stream.save(self._temporary, default_blueprint=_blueprint(with_iterations))
        # When a line was written says nothing about the refinement.
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)

    def at(self, frame: int | None = None, iteration: int | None = None) -> None:
        """What is logged from here on belongs to these places of the two timelines, or to none of theirs."""
        self._stream.reset_time()
        for timeline, place in ((FRAME, frame), (ITERATION, iteration)):
            if place is not None:
                self._stream.set_time(timeline, sequence=place)

    def log(self, entity: str, *archetypes: Any, static: bool = False) -> None:
        """Log at the present places; `static` for what holds at all times.

        Raises:
            ValueError: Rerun does not take the data; its own default is a line on stderr.
        """
        self._stream.log(entity, *archetypes, static=static, strict=True)

    def close(self) -> None:
        """Write the end and move the file to its place."""
        self._end()
        os.replace(self._temporary, self.path)

    def abandon(self) -> None:
        """Leave no file behind."""
        self._end()
        self._temporary.unlink(missing_ok=True)

    def _end(self) -> None:
        self._stream.flush()
        self._stream.disconnect()


def _blueprint(with_iterations: bool) -> Any:
    """3D view on the left; both images and, with iterations, the costs on the right."""
    import rerun.blueprint as rrb

    images: list[Any] = [
        rrb.Spatial2DView(origin="world/cam", name="left", contents=["world/cam/**", "world/boxes/**"])
    ]
    images.append(rrb.Spatial2DView(origin="right", name="right"))
    if with_iterations:
        images.append(rrb.TimeSeriesView(origin="costs", name="costs"))
    timeline = ITERATION if with_iterations else FRAME
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin="world", name="3D"), rrb.Vertical(*images)),
        rrb.TimePanel(timeline=timeline),
        collapse_panels=True,
    )
