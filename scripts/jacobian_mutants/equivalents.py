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


_OF_ZERO = "the negative of zero is zero"
_IN_PAIRS = "enters as a square, or twice as a factor"

EQUIVALENTS: tuple[Equivalent, ...] = (
    Equivalent("exp", "torch.bmm(X2, X)", "(torch.bmm(X, X2))", "powers of one matrix commute"),
    Equivalent("tilt_prior_normal", "zero", "(-zero)", _OF_ZERO),
    Equivalent("_higher_exp_coefficients", "0.5 * angle", "(-(0.5 * angle))", "only the square of its sine is used"),
    Equivalent(
        "project",
        "K @ points_cam[..., None]",
        "(-(K @ points_cam[..., None]))",
        "both sides of the ratio u = h_x / h_z change sign",
    ),
    *(
        Equivalent("patch_derivative", text, f"(-{text})" if text.startswith("_") else f"(-({text}))", _IN_PAIRS)
        for text in (
            "_centred(intensity_left, weight)",
            "_centred(residual + intensity_left, weight)",
            "residual + intensity_left",
            "right / contrast",
        )
    ),
)


def reason_for(mutant: Mutant, equivalents: Iterable[Equivalent] = EQUIVALENTS) -> str | None:
    """Why a mutant is excluded; None where it is not."""
    return next((e.reason for e in equivalents if e.matches(mutant)), None)
