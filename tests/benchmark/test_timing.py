"""Timing maths on fake clocks: no test here depends on how fast the machine is."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from directshape_torch.benchmark.timing import InterleavedTimes, Repetitions, Spread, time_interleaved


class FakeClock:
    """Stands still until something takes time."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def takes(self, seconds: float) -> Callable[[], None]:
        def call() -> None:
            self.now += seconds

        return call


def test_quartiles_by_hand() -> None:
    # Sorted 1 2 3 4 10: with the ends included the quartiles are the second and the fourth.
    assert Spread.of([10.0, 3.0, 1.0, 4.0, 2.0]) == Spread(3.0, 2.0, 4.0, 1.0, 5)


def test_one_number_is_its_own_quartiles() -> None:
    assert Spread.of([7.0]) == Spread(7.0, 7.0, 7.0, 7.0, 1)


def test_a_scaled_spread_is_the_spread_of_the_scaled_sample() -> None:
    sample = [1.0, 5.0, 2.0, 8.0]
    assert Spread.of(sample).scaled(4.0) == Spread.of([4.0 * x for x in sample])


def test_each_side_is_timed_by_itself() -> None:
    clock = FakeClock()

    times = time_interleaved(
        {"slow": clock.takes(3.0), "fast": clock.takes(0.5)}, Repetitions(warm_up=1, rounds=4), clock=clock
    )

    assert times.seconds == {"slow": (3.0,) * 4, "fast": (0.5,) * 4}
    assert times.ratio("slow", "fast").median == 6.0


def test_a_drifting_machine_does_not_change_a_ratio() -> None:
    # The machine gets slower by half with every round; medians taken separately would still agree here, but a single
    # median of one side against a median of the other in another round would not.
    times = InterleavedTimes({"a": (2.0, 3.0, 4.5), "b": (1.0, 1.5, 2.25)})

    ratio = times.ratio("a", "b")

    assert (ratio.median, ratio.low, ratio.high) == (2.0, 2.0, 2.0)


def test_the_order_is_reversed_in_every_second_round() -> None:
    called: list[str] = []
    sides = {name: (lambda name=name: called.append(name)) for name in "ab"}

    time_interleaved(sides, Repetitions(warm_up=0, rounds=3))

    assert called == ["a", "b", "b", "a", "a", "b"]


def test_warm_up_calls_are_made_and_do_not_count() -> None:
    calls: list[int] = []

    times = time_interleaved({"a": lambda: calls.append(0)}, Repetitions(warm_up=2, rounds=3))

    assert len(calls) == 5
    assert times.spread("a").count == 3


@pytest.mark.parametrize(("budget_s", "rounds"), [(0.0, 1), (25.0, 3), (1000.0, 7)])
def test_the_budget_ends_the_rounds_but_never_the_first(budget_s: float, rounds: int) -> None:
    clock = FakeClock()

    times = time_interleaved({"a": clock.takes(10.0)}, Repetitions(0, 7, budget_s), clock=clock)

    assert len(times.seconds["a"]) == rounds
