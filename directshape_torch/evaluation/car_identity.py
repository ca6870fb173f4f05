"""Which label lines show the same physical car: a JSON file, schema 1.

    {"schema_version": 1, "labels": {"000516": {"1": {"car": "0005/0", "drive": "0005"}, "2": ...}, ...}}

Keys are the frame and the line of the label file, counted from 1. KITTI's object labels do not know cars from one frame
to the next; without such a file every label counts as a car of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files import atomic_files
from directshape_torch.files.read_files import read_json

TRACKS_SCHEMA_VERSION = 1
_CURE = "see --tracks in docs/file_formats.md"


@dataclass(frozen=True)
class CarIdentity:
    """A physical car and the drive it was seen on; `drive` is None where nobody knows."""

    car: str
    drive: str | None


@dataclass(frozen=True)
class CarTracks:
    """The physical car of label lines.

    Attributes:
        identities: by frame id and label line number, from 1.
    """

    identities: Mapping[tuple[str, int], CarIdentity]

    def identity(self, frame_id: str, label_line: int) -> CarIdentity:
        """The car of a label line; a label that is not listed is a car of its own.

        Examples:
            >>> CarTracks({}).identity("000007", 2)
            CarIdentity(car='000007:2', drive=None)
        """
        return self.identities.get((frame_id, label_line), CarIdentity(f"{frame_id}:{label_line}", None))


def read_tracks(path: Path | str) -> CarTracks:
    """Read a file of `write_tracks`.

    Raises:
        DataFormatError: it is missing, no JSON, or not of this schema; names the entry.
    """
    content = read_json(path, _CURE)
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != TRACKS_SCHEMA_VERSION or not isinstance(content.get("labels"), dict):
        problem = f"is no tracks file of schema {TRACKS_SCHEMA_VERSION} (schema_version is {shown(version)})"
        raise DataFormatError(path, problem, cure=_CURE)
    return CarTracks(
        {
            (frame_id, _line_number(path, frame_id, line)): _identity(path, frame_id, line, entry)
            for frame_id, lines in content["labels"].items()
            for line, entry in _entries(path, frame_id, lines)
        }
    )


def write_tracks(path: Path | str, tracks: CarTracks) -> None:
    """Write the cars of label lines as JSON."""
    labels: dict[str, dict[str, dict[str, str | None]]] = {}
    for (frame_id, line), identity in sorted(tracks.identities.items()):
        labels.setdefault(frame_id, {})[str(line)] = {"car": identity.car, "drive": identity.drive}
    atomic_files.write_json(path, {"schema_version": TRACKS_SCHEMA_VERSION, "labels": labels})


def _entries(path: Path | str, frame_id: str, lines: Any) -> list[tuple[str, Any]]:
    if not isinstance(lines, dict):
        raise DataFormatError(path, f"frame {frame_id} holds no object of label lines", cure=_CURE)
    return list(lines.items())


def _line_number(path: Path | str, frame_id: str, line: str) -> int:
    if not line.isdecimal() or len(line) > 18 or int(line) < 1:
        raise DataFormatError(path, f"frame {frame_id}: {line!r} is no label line number, from 1", cure=_CURE)
    return int(line)


def _identity(path: Path | str, frame_id: str, line: str, entry: Any) -> CarIdentity:
    known = isinstance(entry, dict) and isinstance(entry.get("car"), str)
    if not known or not isinstance(entry.get("drive"), (str, type(None))):
        problem = f'frame {frame_id}, line {line}: expected {{"car": text, "drive": text or null}}, got {shown(entry)}'
        raise DataFormatError(path, problem, cure=_CURE)
    return CarIdentity(entry["car"], entry.get("drive"))
