"""This module holds the ground planes of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.numerics.checks import check_positive, check_rows, check_words
from directshape_torch.numerics.conversion import Given, as_number, working_dtype
from directshape_torch.numerics.records import Dense, TensorRecord


@dataclass(frozen=True)
class GroundPlane(TensorRecord):
    """A `GroundPlane` is one plane a frame: `normal . x_cam + offset = 0`, unit normal pointing up (negative y).

    Attributes:
        normal: (F, 3).
        offset: (F,) height of the camera above the plane, metres; negative where the plane is a hill above the camera.
            NaN makes the cars of its frame fail.
        source: where each plane came from, F entries: "file", "stereo", "camera_height", or the caller's own word.
    """

    normal: Annotated[Tensor, Dense("F", 3)]
    offset: Annotated[Tensor, Dense("F")]
    source: tuple[str, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_words("source", self.source, len(self.normal), "entries")
        downwards = self.normal[:, 1] >= 0
        not_unit = (self.normal.norm(dim=-1) - 1).abs() > 1e-3
        # One wait for the device serves both checks. NaN passes here, and fails the cars of its own frame.
        if bool((downwards | not_unit).any()):
            check_rows("normal", downwards, self.normal, "a normal pointing up (negative y)", "flip the plane's signs")
            check_rows("normal", not_unit, self.normal, "unit length", "divide the plane by its length")

    @classmethod
    def from_camera_height(cls, height_m: float | Given, num_frames: int = 1) -> GroundPlane:
        """A level ground `height_m` below the camera, for rigs without plane files.

        The plane is float32, or float64 where that is PyTorch's default; `FrameBatch.from_images` takes it to the
        dtype of its images.

        Raises:
            InputError: a height that is not above 0, or infinite.

        Examples:
            >>> GroundPlane.from_camera_height(1.65).offset
            tensor([1.6500])
        """
        height = as_number(height_m)
        check_positive("height_m", height, "give the camera's height above the road, in metres")
        dtype = working_dtype(torch.get_default_dtype())
        normal = torch.tensor([[0.0, -1.0, 0.0]], dtype=dtype).repeat(num_frames, 1)
        offset = torch.full((num_frames,), float(height), dtype=dtype)
        return cls(normal, offset, ("camera_height",) * num_frames)
