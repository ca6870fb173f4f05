"""What the codes of a prior do, as an animated GIF (paper, supplement: shapes by modifying the coefficients)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from directshape_torch.io.figure_files import figure_picture, new_figure, write_animation
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import Picture
from directshape_torch.visualize.inspection.field_views import (
    FIELD_LIMIT_M,
    FRONT_VIEW,
    REAR_VIEW,
    SURFACE_LIMIT_M,
    coloured_surface,
    show_section,
)

_SIZE_INCHES = (9.0, 2.6)
_LARGEST, _STEPS_A_CODE, _SECONDS_A_STEP = 2.0, 12, 0.12


def code_path(num_codes: int, steps_a_code: int = _STEPS_A_CODE) -> Tensor:
    """Codes (K steps, K) that go to +2, to -2 and back to the mean shape, one code after the other.

    Examples:
        >>> code_path(2, steps_a_code=4).round().int().tolist()
        [[0, 0], [2, 0], [0, 0], [-2, 0], [0, 0], [0, 2], [0, 0], [0, -2]]
    """
    angle = 2 * math.pi * torch.arange(steps_a_code) / steps_a_code
    swing = _LARGEST * torch.sin(angle)
    blocks = [swing[:, None] * torch.eye(num_codes)[k] for k in range(num_codes)]
    return torch.cat(blocks)


def write_code_animation(path: Path | str, prior: ShapePrior) -> None:
    """Write the GIF: the surface from two sides, coloured by its distance from the mean shape, its field, the codes.

    Raises:
        MissingDependencyError: matplotlib or Pillow is not installed.
    """
    frames = code_frames(prior, code_path(prior.num_codes).to(prior.origin))
    write_animation(path, frames, [_SECONDS_A_STEP] * len(frames))


def code_frames(prior: ShapePrior, codes: Tensor) -> list[Picture]:
    """One picture (h, w, 3) for each of the codes (N, K)."""
    figure = new_figure(*_SIZE_INCHES, "drawing an animation")
    axes = figure.subplots(1, 4, width_ratios=[1, 1, 1, 0.7])
    mean = prior.values(prior.initial_code(1))[0].detach()
    _draw(axes, prior, mean, mean, codes[0])
    # The parts find their places once: they would dance if every picture were laid out anew.
    figure_picture(figure)
    figure.set_layout_engine("none")
    frames = []
    for code in codes:
        for part in axes:
            part.clear()
        _draw(axes, prior, prior.values(code[None])[0].detach(), mean, code)
        frames.append(figure_picture(figure))
    return frames


def _draw(axes: Any, prior: ShapePrior, values: Tensor, mean: Tensor, code: Tensor) -> None:
    for part, direction in zip(axes[:2], (FRONT_VIEW, REAR_VIEW), strict=True):
        part.imshow(coloured_surface(prior, values, mean, direction, SURFACE_LIMIT_M))
        part.axis("off")
    show_section(axes[2], prior, values, FIELD_LIMIT_M)
    axes[3].bar(range(1, len(code) + 1), code.tolist(), color="royalblue")
    axes[3].set(ylim=(-2.2, 2.2), xticks=range(1, len(code) + 1), xlabel="code", yticks=[-2, 0, 2])
    axes[3].grid(alpha=0.3)
