"""What the mutation script is told of one file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """Functions of one file (`Class.method` for methods) and the tests named for them, the quickest first."""

    path: str
    functions: tuple[str, ...]
    tests: tuple[str, ...]
