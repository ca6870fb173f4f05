"""Ground plane files as AVOD writes them, one a frame, in KITTI's `ref` frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.files.text_files import Line, finite_numbers, read_lines

_CURE = "write four lines: '# Plane', 'Width 4', 'Height 1', then a b c d with a x + b y + c z + d = 0"


def read_plane(path: Path | str) -> NDArray[np.float64]:
    """Read a plane `(a, b, c, d)`, `a x_ref + b y_ref + c z_ref + d = 0`, normalised and with its normal up (b < 0).

    Args:
        path: text file whose last line is `a b c d`; lines before it are a header.

    Returns:
        (4,) float64: unit normal and offset in metres.

    Raises:
        DataFormatError: there is no line of four numbers, or the plane is upright.
    """
    lines = read_lines(path)
    if not lines:
        raise DataFormatError(path, "is empty", cure=_CURE)
    return upright_plane(path, finite_numbers(path, lines[-1], 4, cure=_CURE), lines[-1])


def upright_plane(path: Path | str, plane: NDArray[np.float64], line: Line | None = None) -> NDArray[np.float64]:
    """A plane (a, b, c, d) normalised and with its normal up (b < 0).

    Raises:
        DataFormatError: the plane leans by more than 60 degrees; names the file and the line, if there is one.
    """
    length = float(np.linalg.norm(plane[:3]))
    # A ground that leans by more than 60 degrees is a mistake in the order or the frame of the coefficients.
    if not abs(plane[1]) > 0.5 * length:
        raise DataFormatError(
            path,
            "the normal is not near the vertical y axis",
            line_number=None if line is None else line.number,
            line=" ".join(map(str, plane)) if line is None else line.text,
            cure=_CURE,
        )
    return np.asarray(plane / (-np.sign(plane[1]) * length))


def plane_ref_to_cam(
    normal: Tensor,  # (*, 3), the same in both frames
    offset_ref: Tensor,  # (*,) metres
    t_cam_ref: Tensor,  # (*, 3) `x_cam = x_ref + t_cam_ref`
) -> Tensor:  # (*,)
    """Offset of a plane in camera coordinates, given in KITTI's reference frame: `d_cam = d_ref - n . t_cam_ref`.

    Examples:
        >>> import torch
        >>> up = torch.tensor([0.0, -1.0, 0.0])
        >>> plane_ref_to_cam(up, torch.tensor(1.65), torch.tensor([0.06, 0.01, 0.0]))
        tensor(1.6600)
    """
    return offset_ref - (normal * t_cam_ref).sum(dim=-1)
