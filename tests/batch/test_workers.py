"""What happens to the frames of workers that die: tried again, halved, given up alone."""

from __future__ import annotations

from collections.abc import Callable, Collection

import pytest

from directshape_torch.batch.frame_groups import FrameGroup, frame_groups
from directshape_torch.batch.group_refinement import GroupReport
from directshape_torch.batch.workers import GroupDispatch, WorkerDiedError
from directshape_torch.errors import DirectShapeError


class Imagined:
    """Workers that die of what they are told to; the latest group comes back first."""

    def __init__(self, capacity: int, dies: Callable[[FrameGroup, int], bool]) -> None:
        self.capacity, self.dies = capacity, dies
        self.at_work: list[FrameGroup] = []
        self.calls: list[tuple[str, ...]] = []
        self.written: list[str] = []

    def hand_out(self, group: FrameGroup) -> None:
        self.at_work.append(group)
        assert len(self.at_work) <= self.capacity

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | WorkerDiedError]]:
        group = self.at_work.pop()
        times_before = self.calls.count(group.frame_ids)
        self.calls.append(group.frame_ids)
        if self.dies(group, times_before):
            return [(group, WorkerDiedError("killed"))]
        done = [frame_id for frame_id in group.frame_ids if frame_id in group.wanted]
        self.written += done
        return [(group, GroupReport({frame_id: {"state": "done"} for frame_id in done}))]

    def close(self) -> None:
        pass


def nothing(_: Collection[str]) -> Collection[str]:
    return ()


def dispatch(workers: Imagined, size: int = 1, retries: int = 1, frames: str = "abcdefgh") -> GroupDispatch:
    return GroupDispatch(frame_groups(frames, size, ()), workers, retries, nothing)


@pytest.mark.parametrize("capacity", [1, 3, 20])
def test_every_frame_is_refined_once(capacity: int) -> None:
    workers = Imagined(capacity, lambda *_: False)
    run = dispatch(workers, size=3)
    assert len(list(run.reports())) == 3
    assert sorted(workers.written) == list("abcdefgh")
    assert (run.num_deaths, run.lost) == (0, {})


def test_a_death_costs_one_more_try() -> None:
    workers = Imagined(2, lambda group, before: "c" in group.frame_ids and before == 0)
    run = dispatch(workers, size=2)
    list(run.reports())
    assert sorted(workers.written) == list("abcdefgh")
    assert workers.calls.count(("c", "d")) == 2
    assert (run.num_deaths, run.lost) == (1, {})


@pytest.mark.parametrize("retries", [0, 1, 2])
def test_the_frame_that_kills_is_found_among_its_companions(retries: int) -> None:
    workers = Imagined(2, lambda group, _: "c" in group.frame_ids)
    run = dispatch(workers, size=4, retries=retries)
    list(run.reports())
    assert sorted(workers.written) == list("abdefgh")
    assert list(run.lost) == ["c"]
    assert run.lost["c"] == f"its worker died each of {retries + 1} times (killed)"
    for group in (("a", "b", "c", "d"), ("c", "d"), ("c",)):
        assert workers.calls.count(group) == retries + 1
    assert run.num_deaths == 3 * (retries + 1)


def test_what_was_noted_before_the_death_is_not_written_again() -> None:
    workers = Imagined(1, lambda group, before: "a" in group.frame_ids and before == 0)
    run = GroupDispatch(frame_groups("abc", 3, ()), workers, 1, {"a", "b"}.intersection)
    list(run.reports())
    # All three are in the call again, for the sake of the bytes of the third.
    assert workers.calls == [("a", "b", "c")] * 2
    assert workers.written == ["c"]
    run = GroupDispatch(frame_groups("abc", 3, ()), Imagined(1, lambda *_: True), 1, lambda ids: ids)
    assert list(run.reports()) == []
    assert run.lost == {}


def test_workers_that_never_finish_anything_end_the_run() -> None:
    run = dispatch(Imagined(1, lambda *_: True))
    with pytest.raises(DirectShapeError, match=r"workers die before they finish any frame \(killed\)"):
        list(run.reports())
    assert run.num_deaths == 6


def test_groups_are_those_of_the_data_set_whatever_is_left() -> None:
    groups = frame_groups("abcdefg", 3, finished="abcf")
    assert [group.frame_ids for group in groups] == [("d", "e", "f"), ("g",)]
    assert [sorted(group.wanted) for group in groups] == [["d", "e"], ["g"]]
    assert frame_groups("ab", 3, finished="ab") == []
    assert [half.frame_ids for half in groups[0].halves()] == [("d", "e")]
