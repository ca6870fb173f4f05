"""This module learns the errors of a run's detector from refinements of some frames (`RigEstimate.learn`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from directshape_torch.batch.group_refinement import STOPS_THE_RUN
from directshape_torch.config import AcceptanceConfig
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.from_files import evenly
from directshape_torch.rig.rigs import RigEstimates

# With this many differences, standard deviations are accurate to 7 %.
_ENOUGH_RESULTS = 100
_MOST_FRAMES = 60
_EVERY_RESULT = AcceptanceConfig(min_probability_better=0.0, min_probability_not_worse=0.0)


def learn_detector(
    dataset: StereoDataset,
    refiner: DirectShapeRefiner,
    rigs: RigEstimates,
    tell: Callable[[str], object] = lambda _: None,
) -> None:
    """Refine frames until the rigs know the errors of the detector, and let them learn from every result.

    At most 60 frames are taken evenly from the whole data set, whether chosen or not. Frames that cannot be read are
    skipped here and reported when they are refined. `tell` gets the name of each frame.
    """
    config = replace(refiner.config, acceptance=_EVERY_RESULT, check="off", search="off")
    alone = DirectShapeRefiner(refiner.prior, config, refiner.extra_terms, rigs)
    like = refiner.prior.origin
    names = evenly(list(dict.fromkeys([*dataset.layout.frame_ids(), *dataset.frame_ids])))
    for frame_id in names[:_MOST_FRAMES]:
        try:
            loaded = dataset.load(frame_id)
            if not len(loaded.detections):
                continue
            frames, detections = loaded.frame.to(like.device, like.dtype), loaded.detections.to(like.device, like.dtype)
            with torch.no_grad():
                rigs.learn(frames, alone(frames, detections))
        except STOPS_THE_RUN:
            raise
        # Any error of a frame, also lack of memory, is reported when the frame is refined.
        except Exception:
            continue
        tell(frame_id)
        if len(rigs.results) >= _ENOUGH_RESULTS:
            break
