"""Label and result files of KITTI's tracking benchmark: one file a sequence, each line led by frame and track."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.files.text_files import Line, read_lines
from directshape_torch.io.kitti_labels import KittiObject, parse_object

_COLUMNS = "frame track type truncated occluded alpha u_min v_min u_max v_max h w l x y z rotation_y [score]"
_LEADING = 2
_MOST_DIGITS = 9


def read_tracking_objects(path: Path | str) -> dict[int, list[KittiObject]]:
    """The objects of every frame number that occurs; their `raw_line` leaves frame and track out.

    Args:
        path: of a label file (17 columns) or a result file (18 columns, the score last).

    Raises:
        DataFormatError: a line has another number of columns, or something that is no number.
    """
    frames: dict[int, list[KittiObject]] = {}
    for line in read_lines(path):
        words = line.text.split()
        if len(words) not in (17, 18) or not words[0].isdecimal() or len(words[0]) > _MOST_DIGITS:
            raise DataFormatError(
                path,
                f"expected 17 or 18 columns beginning with the frame's number, got {len(words)}",
                line_number=line.number,
                line=line.text,
                cure=f"write one object a line: {_COLUMNS}",
            )
        text = " ".join(words[_LEADING:])
        frames.setdefault(int(words[0]), []).append(parse_object(path, Line(line.number, text, text)))
    return frames
