"""How good timed results are: the figures of `directshape compare`, for the very tensors that were timed."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from directshape_torch.benchmark.workloads import Scene
from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.evaluation.comparison import compare_results
from directshape_torch.io.refinement_files import write_refinement
from directshape_torch.result import RefinementResult


def mean_bev_iou(scene: Scene, results: Mapping[str, RefinementResult]) -> tuple[Estimate, Estimate] | None:
    """Mean bird's-eye overlap with the labels before and after, with its interval over cars.

    Args:
        scene: the frames.
        results: by frame id, one for each frame of the scene.

    Returns:
        Before and after, or None where no refined car has a label that counts.
    """
    with tempfile.TemporaryDirectory() as folder:
        for loaded in scene.frames:
            write_refinement(folder, loaded, results[loaded.frame_id], prior_sha256="")
        frame_ids = [loaded.frame_id for loaded in scene.frames]
        comparison = compare_results(scene.labels, scene.detections, Path(folder), frames=frame_ids)
    if not comparison.overall.num_detections:
        return None
    summary = comparison.overall.metrics["bev_iou_mean"]
    return summary.before, summary.after
