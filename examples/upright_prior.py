"""A prior of one's own: cars stand upright in the camera's frame, whatever the ground plane says.

    python examples/upright_prior.py

A residual of the cars and their state is all that a prior needs (docs/extra_terms.md).
"""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

import directshape_torch
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, RefinementResult
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import State
from directshape_torch.terms.priors import PriorTerm

ROOT = Path(directshape_torch.__file__).parent / "assets" / "demo"


def upright(cars: CarBatch, state: State) -> Tensor:
    """Sines of pitch and roll: what the camera's y axis, seen from the car, has along the car's x and z axes."""
    return state.T_obj_cam[:, [0, 2], 1]


def upright_prior(frames: FrameBatch, detections: Detections, cars: CarBatch, prior: ShapePrior) -> PriorTerm:
    """The term: a standard deviation of 2 degrees is `0.5 / 0.035^2 = 400` in the units of the other priors."""
    return PriorTerm("upright", 400.0, cars, upright, num_rows=2)


def main() -> RefinementResult:
    """Refine the bundled frame with it."""
    dataset = open_dataset("kitti", ROOT, ROOT / "detections" / "noisy_stereo", ROOT / "training" / "masks")
    loaded = dataset.load("000000")
    result = DirectShapeRefiner(extra_terms=[upright_prior])(loaded.frame, loaded.detections)
    column = result.term_names.index("upright")
    for car, status in enumerate(result.status):
        costs = " -> ".join(f"{float(cost[car, column]):.3f}" for cost in (result.cost_before, result.cost_after))
        print(f"car {car}: {status.name}, upright {costs}")
    return result


if __name__ == "__main__":
    main()
