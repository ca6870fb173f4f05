"""Outcomes of a mutation run as text and as JSON."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jacobian_mutants.runner import Outcome

_LONGEST = 90
# How the messages of failed comparisons begin, in pytest's own asserts and in those of torch.
_WRONG_NUMBER = ("AssertionError", "assert", "Failed", "torch.autograd.gradcheck.GradcheckError", "GradcheckError")


def table(outcomes: Sequence[Outcome]) -> str:
    """Two lines for each mutant: where and what, then the verdict and the test that caught it."""
    return "\n".join(f"{_where(outcome)}\n    {_verdict(outcome)}" for outcome in outcomes)


def summary(outcomes: Sequence[Outcome], excluded: Mapping[str | None, int]) -> str:
    """Counts of verdicts, and of excluded mutants by reason."""
    crashed = sum(outcome.verdict == "caught" and not is_wrong_number(outcome) for outcome in outcomes)
    count = Counter(outcome.verdict for outcome in outcomes)
    lines = [
        f"{len(outcomes)} mutants: {count['caught']} caught ({crashed} of them because they crash), "
        f"{count['timed out']} timed out, {count['survived']} survived, {count['no verdict']} without a verdict"
    ]
    lines += [f"excluded as equivalent, {number}: {reason}" for reason, number in excluded.items()]
    return "\n".join(lines)


def is_wrong_number(outcome: Outcome) -> bool:
    """Whether a test saw a wrong result rather than an exception inside the mutant."""
    return outcome.error.startswith(
        ("AssertionError", "assert", "Failed", "GradcheckError", "torch.autograd.gradcheck")
    )


def write_json(path: Path, outcomes: Sequence[Outcome], excluded: Mapping[str | None, int]) -> None:
    """All outcomes, one object each."""
    content = {
        "outcomes": [_as_dict(outcome) for outcome in outcomes],
        "excluded_as_equivalent": [{"reason": reason, "mutants": number} for reason, number in excluded.items()],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _as_dict(outcome: Outcome) -> dict[str, Any]:
    mutant = outcome.mutant
    return {
        "target": outcome.target,
        "file": mutant.path,
        "line": mutant.line,
        "function": mutant.function,
        "kind": mutant.kind,
        "before": mutant.before,
        "after": mutant.after,
        "verdict": outcome.verdict,
        "caught_by": outcome.caught_by,
        "error": outcome.error,
    }


def _where(outcome: Outcome) -> str:
    m = outcome.mutant
    return f"{m.path}:{m.line} {m.function}: {m.kind}: {_short(m.before)} -> {_short(m.after)}"


def _verdict(outcome: Outcome) -> str:
    if outcome.verdict != "caught":
        return f"{outcome.verdict.upper()} {outcome.error}".rstrip()
    how = "" if is_wrong_number(outcome) else f" (crashes: {_short(outcome.error)})"
    return f"caught by {outcome.caught_by or 'the process'}{how}"


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else line[: _LONGEST - 3] + "..."
