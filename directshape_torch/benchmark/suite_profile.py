"""`--profile`: the time of one eager refinement of the bundled frame by stages."""

from __future__ import annotations

from functools import partial

from directshape_torch.benchmark.presets import make_refiner
from directshape_torch.benchmark.rows import Row, SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.stage_profile import StageProfile, profile_stages
from directshape_torch.benchmark.stage_rules import STAGES
from directshape_torch.benchmark.timing import Spread
from directshape_torch.benchmark.workloads import demo_scene
from directshape_torch.io.frame_collation import collate

_SUITE = "profile"
_MOST_NAMES = 5


def run_profile(settings: SuiteSettings) -> SuiteResult:
    """Median over a few calls of the milliseconds of each stage."""
    frames, detections = collate(demo_scene().frames)
    refiner = make_refiner("default", "eager")
    settings.progress("profile: one eager refinement, by stage")
    for _ in range(settings.repetitions.warm_up):
        refiner(frames, detections)
    rounds = 1 if settings.quick else 5
    profiles = [profile_stages(partial(refiner, frames, detections)) for _ in range(rounds)]
    return SuiteResult(_SUITE, tuple(_rows(profiles)), notes=tuple(_notes(profiles, len(detections))))


def _rows(profiles: list[StageProfile]) -> list[Row]:
    rows = []
    for stage, meaning in STAGES.items():
        ms = Spread.of([1e3 * p.seconds[stage] for p in profiles])
        share = Spread.of([100 * p.share(stage) for p in profiles]).median
        rows.append(
            Row(_SUITE, stage, ms.median, "ms", "time", ms.low, ms.high, ms.count, note=f"{share:.1f} %: {meaning}")
        )
    whole = Spread.of([1e3 * p.total_s for p in profiles])
    rows.append(Row(_SUITE, "whole call", whole.median, "ms", "time", whole.low, whole.high, whole.count))
    return rows


def _notes(profiles: list[StageProfile], num_cars: int) -> list[str]:
    notes = [
        f"default preset, eager, the bundled frame with {num_cars} cars; exclusive times, with the hook's own cost"
    ]
    names = sorted(profiles[-1].unattributed.items(), key=lambda item: -item[1])[:_MOST_NAMES]
    if names:
        notes.append("no rule knows " + ", ".join(f"{name} ({1e3 * s:.1f} ms)" for name, s in names))
    return notes
