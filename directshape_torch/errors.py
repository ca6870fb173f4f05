"""This module has every error that a user can meet; all derive from `DirectShapeError`."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_LONGEST_MESSAGE = 2000
_LONGEST_PART = 400


class DirectShapeError(Exception):
    """`DirectShapeError` is the base of all errors that this package raises on purpose; it shortens long messages."""

    def __init__(self, message: str = "") -> None:
        super().__init__(shortened(message, _LONGEST_MESSAGE))

    def __reduce__(self) -> tuple[Any, ...]:
        # Constructors take other arguments than the message, so another process makes the error without them.
        return _made_anew, (type(self), self.args), vars(self)


def _made_anew(kind: type[DirectShapeError], args: tuple[object, ...]) -> DirectShapeError:
    error = kind.__new__(kind, *args)
    super(DirectShapeError, error).__init__(*args)
    return error


class InputError(DirectShapeError, ValueError):
    """An argument has a wrong shape, type or value; the message has its name, what was expected, what came, a cure."""

    def __init__(self, name: str, expected: str, got: str, cure: str = "") -> None:
        super().__init__(f"{name}: expected {expected}, got {shortened(got)}" + (f"; {cure}" if cure else ""))
        self.name = name


class DataFormatError(DirectShapeError, ValueError):
    """A file does not hold what its format demands; the message names the file, and line number and text if known."""

    def __init__(
        self,
        path: Path | str,
        problem: str,
        *,
        line_number: int | None = None,
        line: str | None = None,
        cure: str = "",
    ) -> None:
        where = f"{path}" + (f", line {line_number}" if line_number is not None else "")
        text = f": {shortened(line)!r}" if line is not None else ""
        super().__init__(f"{where}: {shortened(problem)}{text}" + (f"; {cure}" if cure else ""))
        self.path = Path(path)
        self.line_number = line_number


class ConfigError(DirectShapeError, ValueError):
    """A configuration key or value is unknown or out of range."""


class MeshError(DirectShapeError, ValueError):
    """A mesh cannot be made solid, or a field has no surface."""


class UnlikelyMeshError(MeshError):
    """A mesh does not look like a car by the axes and unit that it is said to have.

    Attributes:
        found: which mesh, what was measured, and what it looks like.
        cure: fields of `MeshOptions` by which it would look like a car; empty where none would.
    """

    def __init__(self, found: str, cure: Mapping[str, str | float]) -> None:
        options = ", ".join(f"{name}={value!r}" for name, value in cure.items())
        needs = f"it needs MeshOptions({options}), or " if cure else ""
        super().__init__(f"{found}; {needs}MeshOptions(are_cars=False) if it is of another class")
        self.found, self.cure = found, dict(cure)


class ResumeError(DirectShapeError):
    """An output folder was made by another configuration, prior or input than the present run."""


class SceneWarning(UserWarning):
    """A refiner found a mistake in images, calibration, masks or boxes (setting `check`)."""


class PriorWarning(UserWarning):
    """The mean shape of a prior's file does not look like a car, though the file says that its shapes are cars."""


class NoGradientWarning(UserWarning):
    """Gradients of a refiner's inputs are wanted, and its settings give none (setting `backward.mode`)."""


class CompilationError(DirectShapeError, RuntimeError):
    """Compiled functions were asked for (`compile: on`) where they are not available."""


class MissingDependencyError(DirectShapeError, ImportError):
    """An optional package is needed for what was asked; `extra` is empty where no extra of this package has it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        cure = f"install it with: pip install 'directshape_torch[{extra}]'" if extra else "install it as its pages say"
        super().__init__(f"{purpose} needs the package {package!r}; {cure}")


def shortened(text: str, most: int = _LONGEST_PART) -> str:
    """A text whose middle is left out where it is longer than `most` characters.

    Examples:
        >>> shortened("abcdefghijklmnopqrstuvwxyz", 16)
        'abcdefgh .. wxyz'
    """
    return text if len(text) <= most else f"{text[: most - most // 4 - 4]} .. {text[len(text) - most // 4 :]}"


class _Shown(reprlib.Repr):
    """`_Shown` keeps texts short, also of values that are nested deeply or that hold one part over and over."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxstring, self.maxother, self.maxlong = 3, _LONGEST_PART, _LONGEST_PART, 40
        self.maxlist = self.maxtuple = self.maxdict = 8


shown = _Shown().repr
"""`shown` gives the `repr` of a value that came from a file, which is always short."""
