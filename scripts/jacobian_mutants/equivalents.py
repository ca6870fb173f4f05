"""Mutants that no test can tell from the original, each with the reason why. Everything else must be caught."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from jacobian_mutants.mutants import Mutant


@dataclass(frozen=True)
class Equivalent:
    """Mutants of a function that compute the same: those of this text, to `after` or, where None, to anything."""

    function: str
    before: str
    after: str | None
    reason: str

    def matches(self, mutant: Mutant) -> bool:
        same = mutant.function == self.function and mutant.before == self.before
        return same and self.after in (None, mutant.after)


EQUIVALENTS: tuple[Equivalent, ...] = ()


def reason_for(mutant: Mutant, equivalents: Iterable[Equivalent] = EQUIVALENTS) -> str | None:
    """Why a mutant is excluded; None where it is not."""
    return next((e.reason for e in equivalents if e.matches(mutant)), None)
