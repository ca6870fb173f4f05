"""The refiners that are measured: a preset, compiled or not, with single settings changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from directshape_torch.benchmark.machine import compiler
from directshape_torch.config import RefinerConfig
from directshape_torch.config_files import load_config
from directshape_torch.refiner import DirectShapeRefiner

MODES = {"eager": "off", "compiled": "on"}
"""Value of the setting `compile` by the name of a mode."""


def available_modes() -> tuple[str, ...]:
    """The modes that can run here: "eager" always, "compiled" where there is a compiler and the setting."""
    can_compile = _has_compile_setting() and compiler() is not None
    return tuple(MODES) if can_compile else ("eager",)


def make_refiner(preset: str, mode: str, overrides: Sequence[str] = ()) -> DirectShapeRefiner:
    """A refiner with a preset's settings, on the CPU.

    Args:
        preset: "default", "fast" or "paper", or a file.
        mode: of `MODES`.
        overrides: `key=value`.
    """
    compiling = [f'compile="{MODES[mode]}"'] if _has_compile_setting() else []
    return DirectShapeRefiner(config=load_config(preset, [*compiling, *overrides]))


def _has_compile_setting() -> bool:
    return any(field.name == "compile" for field in fields(RefinerConfig))
