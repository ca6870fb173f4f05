"""One frame of a run as far as it is known, and what all frames share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.observation.occlusion import OcclusionOrder
from directshape_torch.report.drawn_frame import CarState, ObjectMesh
from directshape_torch.report.frame_inputs import FrameInputs
from directshape_torch.report.residual_maps import MapSettings
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import Array


@dataclass(frozen=True)
class FrameMaterial:
    """One frame as far as it is known.

    Attributes:
        result: what the run left.
        inputs: what went in.
        lines: all lines of the detection file, or None.
        detections: those of the cars of `result`, or None.
        labels: the truth, or None.
    """

    result: FrameResult
    inputs: FrameInputs
    lines: list[KittiObject] | None
    detections: list[KittiObject] | None
    labels: list[KittiObject] | None


@dataclass(frozen=True)
class DetailSettings:
    """What all frames share.

    Attributes:
        classes: refined types.
        prior: shapes, or None where those of the run are not at hand.
        mean: the mesh of its mean shape.
        maps: settings of residual maps.
        occlusion_order: see `instances_in_front`.
    """

    classes: Sequence[str]
    prior: ShapePrior | None
    mean: ObjectMesh | None
    maps: MapSettings
    occlusion_order: OcclusionOrder


@dataclass(frozen=True)
class DrawnCars:
    """The cars of a frame, in the left camera frame.

    Attributes:
        before: as they were detected, or None where nobody knows.
        after: as they are now.
        truth: (8, 3) corners of each labelled box, metres.
    """

    before: list[CarState] | None
    after: list[CarState]
    truth: list[Array]

    def states(self, car: int) -> dict[str, CarState]:
        """A car "before", where that is known, and "after"."""
        after = {"after": self.after[car]}
        return after if self.before is None else {"before": self.before[car], **after}
