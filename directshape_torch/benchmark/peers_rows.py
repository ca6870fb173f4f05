"""From the runs of several solvers to rows of the benchmark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from directshape_torch.benchmark.peers_task import StageRun, StageTask
from directshape_torch.benchmark.rows import Goal, Row
from directshape_torch.benchmark.timing import Spread

SUITE = "peers"


@dataclass
class Figures:
    """What was measured of one solver: one entry for each round of each frame, or for each car of each frame.

    Attributes:
        name: of the solver.
        goal: how many times slower than the reference it should be, or None.
        seconds: of all stages of all cars of a frame.
        near_seconds: until all cars had a cost of at most 1.01 times ours.
        cars: of the frame, for each entry of `seconds`.
        cost_ratios: final cost over ours, of every car and stage.
        iterations: of every car, all stages.
        energy_seconds: of all its runs, the warm-up among them, in residuals and their tangents, which are our
            functions; NaN if unknown.
        all_seconds: of the same runs.
    """

    name: str
    goal: Goal | None = None
    seconds: list[float] = field(default_factory=list)
    near_seconds: list[float] = field(default_factory=list)
    cars: list[int] = field(default_factory=list)
    cost_ratios: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    energy_seconds: float = 0.0
    all_seconds: float = 0.0

    def add_round(self, seconds: float, runs: Sequence[StageRun], tasks: Sequence[StageTask]) -> None:
        """One round of one frame."""
        self.seconds.append(seconds)
        self.cars.append(len(tasks[0].start.code))
        pairs = list(zip(runs, tasks, strict=True))
        known = all(run.traces for run in runs)
        self.near_seconds.append(sum(r.seconds_to(t.near_cost) for r, t in pairs) if known else math.nan)

    def add_costs(self, runs: Sequence[StageRun], tasks: Sequence[StageTask]) -> None:
        """Where the cars of one frame ended; the same in every round."""
        for run, task in zip(runs, tasks, strict=True):
            with torch.no_grad():
                self.cost_ratios += (task.problem.cost(run.state) / task.target_cost).tolist()
        self.iterations += torch.stack([run.iterations for run in runs]).sum(dim=0).tolist()


def time_row(figures: Figures) -> Row:
    """Milliseconds per car."""
    each = [1000 * s / cars for s, cars in zip(figures.seconds, figures.cars, strict=True)]
    spread, iterations = Spread.of(each), Spread.of([float(n) for n in figures.iterations])
    notes = [f"per car, all stages; {iterations.median:g} iterations"]
    if not math.isnan(figures.energy_seconds):
        notes.append(f"{100 * figures.energy_seconds / figures.all_seconds:.0f} % in residuals and their tangents")
    return Row(
        SUITE, figures.name, spread.median, "ms", "time", spread.low, spread.high, spread.count, note="; ".join(notes)
    )


def ratio_rows(figures: Figures, reference: Figures, near_reference: Figures, is_goal: bool) -> list[Row]:
    """How many times slower than ours, within the same rounds: to its own end, and until near our cost.

    Args:
        figures: of the other solver.
        reference: ours.
        near_reference: ours with no more iterations than it needs until near its cost.
        is_goal: are these the rows that the goal is for?
    """
    name = f"{figures.name} over {reference.name}"
    goal = figures.goal if is_goal else None
    rows = [_ratio_row(name, figures.seconds, reference.seconds, goal, "to its own end")]
    if not any(math.isnan(s) for s in figures.near_seconds):
        note = "both until within 1 % of our final cost"
        rows.append(_ratio_row(f"{name}, near our cost", figures.near_seconds, near_reference.seconds, None, note))
    return rows


def cost_rows(figures: Figures) -> list[Row]:
    """Where it ended, over ours, of all cars and stages."""
    spread = Spread.of(figures.cost_ratios)
    near = sum(ratio <= 1.01 for ratio in figures.cost_ratios) / spread.count
    worst = f"{min(figures.cost_ratios):.3f} to {max(figures.cost_ratios):.3f}, cars and stages"
    return [
        Row(SUITE, f"{figures.name}, final cost over ours", spread.median, "", "accuracy",
            spread.low, spread.high, spread.count, note=worst),
        Row(SUITE, f"{figures.name}, at our cost or within 1 %", near, "", "accuracy", count=spread.count,
            better="higher", note="share of cars and stages"),
    ]  # fmt: skip


def _ratio_row(name: str, slow: Sequence[float], fast: Sequence[float], goal: Goal | None, note: str) -> Row:
    spread = Spread.of([a / b for a, b in zip(slow, fast, strict=True)])
    return Row(
        SUITE, name, spread.median, "", "ratio", spread.low, spread.high, spread.count, "higher", goal=goal, note=note
    )
