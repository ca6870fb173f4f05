"""Which frames get pictures and 3D views when a run has more of them than fit a page."""

from __future__ import annotations

from collections.abc import Sequence

from directshape_torch.report.car_rows import CarRow


def car_gains(rows: Sequence[CarRow]) -> list[tuple[float, int]]:
    """How much better each car became, and the number of its frame, worst first.

    By the overlap with the label where the run has labels, else by the probability to be better; the two cannot be
    compared. Cars that were not refined have none. The page's `highlights.js` ranks by the same rule.
    """
    refined = [row for row in rows if row.refined]
    judged = [(row.iou_before, row.iou_after, row.frame) for row in refined]
    by_labels = [(after - before, f) for before, after, f in judged if before is not None and after is not None]
    if any(row.iou_before is not None for row in rows):
        return sorted(by_labels)
    return sorted((row.probability_better, row.frame) for row in refined if row.probability_better is not None)


def choose_frames(rows: Sequence[CarRow], num_frames: int, most: int) -> list[int]:
    """Numbers of the frames to show, ascending: those of the worst and best cars first, then evenly over the run.

    Examples:
        >>> choose_frames([], 10, 3)
        [0, 3, 6]
    """
    if num_frames <= most:
        return list(range(num_frames))
    gains = car_gains(rows)
    ranked = [frame for pair in zip(gains, reversed(gains), strict=True) for _, frame in pair]
    # At most half of the frames for the extremes: a page of nothing else would mislead.
    chosen = list(dict.fromkeys(ranked))[: most // 2]
    evenly = [number * num_frames // most for number in range(most)]
    rest = [frame for frame in (*evenly, *range(num_frames)) if frame not in set(chosen)]
    return sorted([*chosen, *list(dict.fromkeys(rest))[: most - len(chosen)]])
