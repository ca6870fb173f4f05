"""This module groups the frames that are refined together, in a way that depends only on the data set."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import groupby


@dataclass(frozen=True)
class FrameGroup:
    """A `FrameGroup` has the frames of one call of the refiner."""

    frame_ids: tuple[str, ...]  # all of them; the last digits of a result depend on the other frames
    # Frames whose files are to be written. The others are finished already, or another call writes them.
    wanted: frozenset[str]

    def without(self, finished: Collection[str]) -> FrameGroup:
        """The group without the finished frames among those that are to be written."""
        return replace(self, wanted=self.wanted.difference(finished))

    def halves(self) -> tuple[FrameGroup, ...]:
        """The halves of the group that have frames to write."""
        middle = (len(self.frame_ids) + 1) // 2
        parts = (self.frame_ids[:middle], self.frame_ids[middle:])
        return tuple(FrameGroup(part, self.wanted.intersection(part)) for part in parts if self.wanted & set(part))


def frame_groups(frame_ids: Sequence[str], size: int, finished: Collection[str]) -> list[FrameGroup]:
    """The groups of a run.

    If only some frames of a group are finished, the whole group is refined again, so that the other frames get the same
    bytes as without the interruption.

    Examples:
        >>> [group.frame_ids for group in frame_groups("abcde", 2, finished={"a", "b", "c"})]
        [('c', 'd'), ('e',)]
    """
    finished = frozenset(finished)
    groups = (tuple(frame_ids[first : first + size]) for first in range(0, len(frame_ids), size))
    return [FrameGroup(ids, frozenset(ids) - finished) for ids in groups if not finished.issuperset(ids)]


def track_windows(
    frame_ids: Sequence[str], sequence_of: Callable[[str], str | None], size: int, finished: Collection[str]
) -> list[FrameGroup]:
    """The groups of a run with tracks: whole sequences, or windows of a sequence that overlap by half.

    A frame is written by the window whose middle is nearest. Finished frames do not change the results of others.

    Examples:
        >>> windows = track_windows("abcdef", lambda _: "", 4, finished={"e"})
        >>> [(window.frame_ids, sorted(window.wanted)) for window in windows]
        [(('a', 'b', 'c', 'd'), ['a', 'b', 'c']), (('c', 'd', 'e', 'f'), ['d', 'f'])]
    """
    windows = []
    for _, members in groupby(sorted(frame_ids, key=lambda frame: (sequence_of(frame) or "", frame)), sequence_of):
        ids = tuple(members)
        last = max(len(ids) - size, 0)
        starts = [*range(0, last, max(size // 2, 1)), last]
        nearest = [min(starts, key=lambda first: abs(2 * (k - first) + 1 - size)) for k in range(len(ids))]
        for first in starts:
            wanted = frozenset(name for name, start in zip(ids, nearest, strict=True) if start == first)
            windows.append(FrameGroup(ids[first : first + size], wanted.difference(finished)))
    return [window for window in windows if window.wanted]
