"""Label and result files of KITTI's tracking benchmark: one file a sequence, each line led by frame and track."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from directshape_torch.errors import InputError
from directshape_torch.files.read_files import Line, read_lines
from directshape_torch.io.instance_masks import file_of_frame
from directshape_torch.io.kitti_labels import KittiObject, parse_object, read_objects

_COLUMNS = "frame track type truncated occluded alpha u_min v_min u_max v_max h w l x y z rotation_y [score]"
_LEADING = 2
_MOST_DIGITS = 9


def read_tracking_objects(path: Path | str) -> dict[int, list[KittiObject]]:
    """The objects of every frame number that occurs, with their tracks.

    Their `raw_line` leaves frame and track out and their `line_number` counts within the frame, as in its own file.

    Args:
        path: of a label file (17 columns) or a result file (18 columns, the score last).

    Raises:
        DataFormatError: a line has another number of columns, or something that is no number.
    """
    frames: dict[int, list[KittiObject]] = {}
    for line in read_lines(path):
        words = line.text.split()
        if len(words) not in (17, 18) or not _is_number(words[0]) or not _is_number(words[1].removeprefix("-")):
            problem = f"expected 17 or 18 columns beginning with the numbers of frame and track, got {len(words)}"
            raise line.error(path, problem, f"write one object a line: {_COLUMNS}")
        text = " ".join(words[_LEADING:])
        objects = frames.setdefault(int(words[0]), [])
        found = parse_object(path, Line(line.number, text, text))
        objects.append(replace(found, track_id=int(words[1]), line_number=len(objects) + 1))
    return frames


class FrameObjects:
    """Objects frame by frame, of files of frames or of the tracking benchmark, each of which is read once."""

    def __init__(self) -> None:
        self._sequences: dict[Path, dict[int, list[KittiObject]]] = {}

    def path(self, source: Path, frame_id: str) -> Path:
        """The file of a frame.

        Args:
            source: a folder of `FRAME.txt` or `SEQUENCE.txt`, or one with `data` of them, or the file of a sequence.
            frame_id: `FRAME`, or `SEQUENCE_NNNNNN`.
        """
        of_frame, sequence = file_of_frame(source, f"{frame_id}.txt"), frame_id.rpartition("_")[0]
        of_sequence = source if source.is_file() else file_of_frame(source, f"{sequence}.txt")
        return of_sequence if not of_frame.is_file() and of_sequence.is_file() else of_frame

    def read(self, path: Path, frame_id: str) -> list[KittiObject]:
        """The objects of a frame in a file that `path` named; raises as `of_sequence`."""
        return read_objects(path) if path.stem == frame_id else self.of_sequence(path, frame_id)

    def of_sequence(self, path: Path, frame_id: str) -> list[KittiObject]:
        """The objects of a frame in a file of the tracking benchmark.

        Raises:
            DataFormatError: the file is missing or damaged.
            InputError: the name of the frame does not end with its number.
        """
        number = frame_number(frame_id)
        if path not in self._sequences:
            self._sequences[path] = read_tracking_objects(path)
        return self._sequences[path].get(number, [])


def frame_number(frame_id: str) -> int:
    """The number of a frame in its sequence, of `NNNNNN` or `SEQUENCE_NNNNNN`.

    Raises:
        InputError: the name does not end with one.

    Examples:
        >>> frame_number("0005_000012")
        12
    """
    number = frame_id.rpartition("_")[2]
    if not _is_number(number.lstrip("0") or number[-1:]):
        raise InputError("frames", "names that end with numbers, for a file of their sequence", repr(frame_id))
    return int(number)


def _is_number(word: str) -> bool:
    return word.isdecimal() and len(word) <= _MOST_DIGITS
