"""The refiners that are measured: a preset, compiled or not, with single settings changed."""

from __future__ import annotations

from collections.abc import Sequence

# The one place that knows where the compiler is.
from directshape_torch.compile import compiler_problem, num_forms
from directshape_torch.config_files import load_config
from directshape_torch.refiner import DirectShapeRefiner

__all__ = ["MODES", "available_modes", "compiler_problem", "make_refiner", "num_forms", "unavailable_modes"]

MODES = {"eager": "off", "compiled": "on"}
"""Value of the setting `compile` by the name of a mode."""
ENDLESS = ("solver.cost_tolerance=0", "solver.step_tolerance=0", "solver.accept_every_step=true")
"""Settings with which no car settles, so that every car takes part in every iteration."""


def available_modes() -> tuple[str, ...]:
    """The modes that can run here: "eager" always, "compiled" where there is a working compiler."""
    return tuple(MODES) if compiler_problem() is None else ("eager",)


def unavailable_modes() -> tuple[str, ...]:
    """The other ones."""
    return tuple(mode for mode in MODES if mode not in available_modes())


def make_refiner(preset: str, mode: str, overrides: Sequence[str] = ()) -> DirectShapeRefiner:
    """A refiner with a preset's settings, on the CPU.

    Args:
        preset: "default", "fast" or "paper", or a file.
        mode: of `MODES`.
        overrides: `key=value`.

    Examples:
        >>> make_refiner("fast", "eager", ["silhouette.weight=6"]).config.silhouette.weight
        6.0
    """
    return DirectShapeRefiner(config=load_config(preset, [f"compile={MODES[mode]}", *overrides]))
