"""Times of the images, where files tell them, and images that occur twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from directshape_torch.errors import DataFormatError
from directshape_torch.io.stereo_files import FileStereoDataset
from directshape_torch.scene_check.finding import Finding, Severity, unreadable

# At 15 m/s a car moves 7 cm in 5 ms.
PAIR_WARNING_S, PAIR_ERROR_S = 0.005, 0.02


def check_times(dataset: FileStereoDataset, frame_ids: Sequence[str]) -> list[Finding]:
    """Differences between left and right times, and times that do not grow from frame to frame of a sequence."""
    times: dict[str, tuple[float, float]] = {}
    for frame_id in frame_ids:
        try:
            both = dataset.layout.times_s(frame_id)
        except DataFormatError as error:
            # A frame's own file is looked into when the frame is read.
            if error.path != dataset.detection_path(frame_id):
                cure = "write one time a frame, or remove the file"
                return [unreadable("time_file", "all frames", "a time for each frame", error, cure)]
            continue
        if both is not None:
            times[frame_id] = both
    return _check_pairs(times) + _check_order(times)


def _check_pairs(times: dict[str, tuple[float, float]]) -> list[Finding]:
    apart = {frame_id: abs(left - right) for frame_id, (left, right) in times.items()}
    late = {frame_id: seconds for frame_id, seconds in apart.items() if seconds > PAIR_WARNING_S}
    if not late:
        return []
    worst = max(late, key=lambda frame_id: late[frame_id])
    severity: Severity = "error" if late[worst] > PAIR_ERROR_S else "warning"
    return [
        Finding(
            "pair_times",
            severity,
            f"{len(late)} of {len(times)} frames",
            f"left and right image are up to {1000 * late[worst]:.1f} ms apart (frame {worst})",
            f"at most {1000 * PAIR_WARNING_S:.0f} ms",
            "pair images by their times, not by their place in a list; trigger the cameras together",
        )
    ]


def _check_order(times: dict[str, tuple[float, float]]) -> list[Finding]:
    """Within a sequence, whose name is all before the last underscore."""
    sequences: dict[str, list[str]] = {}
    for frame_id in times:
        sequences.setdefault(frame_id.rpartition("_")[0], []).append(frame_id)
    findings = []
    for members in sequences.values():
        steps = np.diff([times[frame_id][0] for frame_id in members])
        wrong = np.flatnonzero(steps <= 0)
        if len(wrong):
            at = members[wrong[0] + 1]
            findings.append(
                Finding(
                    "time_order",
                    "error",
                    f"frame {at}",
                    f"its time is {-steps[wrong[0]]:.3f} s before that of {members[wrong[0]]}",
                    "times that grow with the names of the frames",
                    "name frames in the order of their times",
                )
            )
    return findings
