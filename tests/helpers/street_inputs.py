"""This module makes a rendered street a function of one number that enters every differentiable input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.config import BackwardConfig, RefinerConfig, StageConfig
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed

# Undamped steps settle where the gradient vanishes; accepting by the cost ends within the rounding of the cost.
SETTLED = replace(
    DEFAULT,
    stages=(StageConfig(2.0, 1, 10), StageConfig(1.0, 0, 40)),
    # What a stage fixes at its start, the state that the gain comes from among it, is constant for gradients alone.
    photometric=replace(DEFAULT.photometric, brightness="none"),
    solver=replace(
        DEFAULT.solver,
        cost_tolerance=0.0,
        step_tolerance=1e-9,
        accept_every_step=True,
        initial_damping=0,
        rays="marched",  # as every refinement that is differentiated
    ),
)
# Where it does not matter whether the gradient vanishes.
UNSETTLED = replace(SETTLED, stages=(StageConfig(2.0, 1, 2), StageConfig(1.0, 0, 3)))


class StreetInputs:
    """A `StreetInputs` has all differentiable inputs, each moved along a seeded direction by a scalar."""

    def __init__(self) -> None:
        self.prior, self.scene = cached_street()
        self.detections = disturbed(self.scene.detections)
        generator = torch.Generator().manual_seed(5)

        def noise(like: Tensor) -> Tensor:
            return torch.randn(like.shape, generator=generator, dtype=like.dtype)

        # Clamped mask probabilities have no gradient.
        self.mask = self.detections.mask_left.dense().clamp(0.2, 0.8)
        self.mask_direction = 0.1 * noise(self.mask)
        self.image_direction = 0.02 * noise(self.scene.frames.images_right)
        self.basis_direction = 0.05 * self.prior.basis.flip(-1)
        self.mean_direction = 0.02 * torch.ones_like(self.prior.mean)

    def refine(self, config: RefinerConfig, what: str = "nothing", by: Tensor | float = 0.0) -> RefinementResult:
        return self.refine_by(config, {what: by})

    def refine_by(self, config: RefinerConfig, steps: Mapping[str, Tensor | float]) -> RefinementResult:
        """The result with each named input moved by its step."""
        frames, detections, weights = self.scene.frames, replace(self.detections, mask_left=self.mask), None
        prior, of_prior = self.prior, {}
        for what, by in steps.items():
            if what == "masks":
                detections = replace(detections, mask_left=self.mask + by * self.mask_direction)
            elif what == "images":
                frames = replace(frames, images_right=frames.images_right + by * self.image_direction)
            elif what == "weights":
                weights = {"silhouette_left": torch.ones(len(detections), dtype=torch.float64) * (1 + by)}
            elif what == "basis":
                of_prior["basis"] = of_prior.get("basis", prior.basis) + by * self.basis_direction
            elif what == "sigma":
                sigma = 1 + by * torch.ones(prior.num_codes, dtype=torch.float64)
                of_prior["basis"] = of_prior.get("basis", prior.basis) * sigma
                of_prior["dimensions_basis_hwl"] = prior.dimensions_basis_hwl * sigma
            elif what == "mean":
                of_prior["mean"] = prior.mean + by * self.mean_direction
            elif what == "dimensions":
                detections = replace(detections, dimensions_hwl=detections.dimensions_hwl + by)
            elif what == "pose":
                shift = torch.zeros_like(detections.T_cam_obj)
                shift[:, 0, 3] = 1.0
                detections = replace(detections, T_cam_obj=detections.T_cam_obj + by * shift)
        refiner = DirectShapeRefiner(_prior_with(**of_prior) if of_prior else prior, config)
        result: RefinementResult = refiner(frames, detections, weights)
        return result


def _prior_with(**tensors: Tensor) -> PCAShapePrior:
    copy = ellipsoid_prior()
    for name, tensor in tensors.items():
        setattr(copy, name, tensor)
    return copy


def summary(result: RefinementResult) -> Tensor:
    """One number that depends on position, heading and shape of every car."""
    weight = torch.arange(1, result.code.shape[1] + 1, dtype=torch.float64)
    return result.T_cam_obj[:, :3, 3].sum() + result.T_cam_obj[:, 0, 2].sum() + (result.code * weight).sum()


def gradient_by(inputs: StreetInputs, config: RefinerConfig, what: str) -> float:
    return gradients_by(inputs, config, [what])[what]


def gradients_by(inputs: StreetInputs, config: RefinerConfig, names: Sequence[str]) -> dict[str, float]:
    """The gradients of the summary of one refinement by several inputs."""
    steps = {name: torch.zeros((), dtype=torch.float64, requires_grad=True) for name in names}
    found = torch.autograd.grad(summary(inputs.refine_by(config, steps)), list(steps.values()))
    return {name: float(gradient) for name, gradient in zip(names, found, strict=True)}


def unsettled(mode: str) -> RefinerConfig:
    return with_mode(mode, UNSETTLED, max_remaining_step=1e9)


def with_mode(mode: str, config: RefinerConfig = SETTLED, **settings: float) -> RefinerConfig:
    return replace(config, backward=BackwardConfig(mode=mode, **{"unroll_iterations": 200, **settings}))  # type: ignore[arg-type]
