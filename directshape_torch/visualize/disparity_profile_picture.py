"""Disparity profiles of some cars as a picture: a panel each, before and after, with the minimum of either curve."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from directshape_torch.diagnosis.disparity_profile import DisparityProfile, ProfileFigures
from directshape_torch.errors import InputError
from directshape_torch.visualize.panel_row import write_panel_row

_PANEL_INCHES = 2.9


class _Curve(NamedTuple):
    """One line of a panel and where its minimum lies."""

    name: str
    cost: Tensor  # (n,)
    offset_px: float
    lowest: float


class _Panel(NamedTuple):
    title: str
    offsets_px: Tensor  # (n,)
    curves: tuple[_Curve, ...]


def write_profile_picture(path: Path | str, profile: DisparityProfile, names: Sequence[str], title: str) -> None:
    """Write the curves of all cars of a profile side by side as PNG.

    Args:
        path: of the picture.
        profile: B cars; those without a curve have an empty panel.
        names: B titles of the panels.
        title: of the picture.

    Raises:
        InputError: no cars, or not one name each.
        MissingDependencyError: matplotlib is not installed.

    Examples:
        >>> import tempfile, torch
        >>> from directshape_torch.diagnosis.disparity_profile import profile_offsets
        >>> offsets, path = profile_offsets(), Path(tempfile.mkdtemp()) / "profiles.png"
        >>> curve = 5 + offsets[None] ** 2
        >>> write_profile_picture(path, DisparityProfile(offsets, 2 * curve, curve, torch.ones(1)), ["a car"], "cars")
        >>> path.read_bytes()[1:4]
        b'PNG'
    """
    if len(names) != len(profile.cost_after):
        raise InputError("names", f"one for each of {len(profile.cost_after)} cars", f"{len(names)}")
    both = (("before", profile.cost_before, profile.before), ("after", profile.cost_after, profile.after))
    panels = [
        _Panel(
            _panel_title(name, profile.after, row),
            profile.offsets_px.cpu(),
            tuple(_curve(kind, costs[row].cpu(), figures, row) for kind, costs, figures in both),
        )
        for row, name in enumerate(names)
    ]
    write_panel_row(path, panels, _draw, title, _PANEL_INCHES, "plotting disparity profiles")


def _curve(name: str, cost: Tensor, figures: ProfileFigures, row: int) -> _Curve:
    return _Curve(name, cost, float(figures.offset_px[row]), float(cost.min()))


def _panel_title(name: str, after: ProfileFigures, row: int) -> str:
    """The car's name and, on a line of its own, what is to be minded."""
    minded = ["ambiguous"] * bool(after.ambiguous[row])
    if bool(after.offset_px[row].isnan()):
        minded = ["no pixels"]
    elif not bool(after.in_basin[row]):
        minded.append("in another valley")
    return "\n".join([name, ", ".join(minded)])


def _draw(axes: Any, panel: _Panel) -> None:
    # The grey line is where the car was put: at offset 0 of both curves, though not at the same place.
    axes.axvline(0, color="0.8", linewidth=1)
    for curve, style in zip(panel.curves, ("--", "-"), strict=True):
        (line,) = axes.plot(panel.offsets_px, curve.cost, style, label=curve.name)
        axes.plot([curve.offset_px], [curve.lowest], "o", color=line.get_color(), markersize=5)
    axes.set_title(panel.title, fontsize=9)
    axes.set(xlabel="offset of the disparity [px]", ylabel="photometric cost")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
