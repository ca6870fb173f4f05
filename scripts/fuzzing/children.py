"""Child processes that do cases, each watched: what crashes, hangs or eats memory ends with its child alone."""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

OUTCOMES = ("accepted", "refused", "foreign exception", "silent NaN", "crash", "hang", "over memory")
_SCRIPT = Path(__file__).parent.parent / "fuzz.py"
# A child reads its samples first.
_PATIENCE_AT_START_S = 1800.0


@dataclass
class Tally:
    """How the cases of one kind ended."""

    counts: Counter[str] = field(default_factory=Counter)  # by outcome
    # Cases that ended as none should: seed, name and what was said.
    found: list[dict[str, Any]] = field(default_factory=list)

    def add(self, answer: dict[str, Any]) -> None:
        """Count one."""
        self.counts[answer["outcome"]] += 1
        if answer["outcome"] not in ("accepted", "refused"):
            self.found.append(answer)


class _Child:
    """A process that answers seeds; started anew where it ended."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._process: subprocess.Popen[str] | None = None

    def ask(self, seed: int, timeout_s: float) -> dict[str, Any]:
        """Its answer, or that there was none."""
        process = self._started()
        assert process.stdin is not None
        process.stdin.write(f"{seed}\n")
        process.stdin.flush()
        line = self._line(process, timeout_s)
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        outcome = "hang" if process.poll() is None and line is None else "crash"
        said = f"{timeout_s:g} s" if outcome == "hang" else f"exit code {process.wait(10)}"
        self.close()
        return {"seed": seed, "name": "", "outcome": outcome, "said": said}

    def close(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            command = [sys.executable, str(_SCRIPT), "--serve", self.kind]
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
            ready = self._line(self._process, _PATIENCE_AT_START_S)
            if ready != "ready\n":
                self.close()
                raise RuntimeError(f"a child did not start; see `{' '.join(command)}`")
        return self._process

    @staticmethod
    def _line(process: subprocess.Popen[str], timeout_s: float) -> str | None:
        """None where it takes longer, "" where the child has ended."""
        assert process.stdout is not None
        readable, _, _ = select.select([process.stdout], [], [], timeout_s)
        return process.stdout.readline() if readable else None


def tally(kind: str, seeds: Iterator[int], timeout_s: float, report: Callable[[str], None]) -> Tally:
    """Do the cases of these seeds in a child."""
    child, found = _Child(kind), Tally()
    try:
        for number, seed in enumerate(seeds):
            answer = child.ask(seed, timeout_s)
            found.add(answer)
            if answer["outcome"] not in ("accepted", "refused"):
                report(f"{kind} {seed}: {answer['outcome']}: {answer['name']}: {answer['said']}")
            if number % 1000 == 999:
                report(f"{kind}: {number + 1}: {dict(found.counts)}")
    finally:
        child.close()
    return found
