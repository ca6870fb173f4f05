"""Refinement with a prior of every kind converges with either Jacobian, and gradients pass through it."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.priors import KINDS, prior_of
from helpers.problems import DEFAULT
from helpers.synthetic_scene import Street, disturbed, street
from torch import Tensor

from directshape_torch.config import BackwardConfig, StageConfig
from directshape_torch.refiner import DirectShapeRefiner

pytestmark = pytest.mark.parametrize("kind", KINDS)
# Few pixels, because every one costs the network many times what it costs a grid.
LIGHT = replace(DEFAULT, sampling=replace(DEFAULT.sampling, min_pixels=100, max_pixels=200))


@pytest.fixture(scope="module")
def scene_of() -> Callable[[str], Street]:
    """A car at 9 m with a code other than the mean's, of the prior itself, rendered once for each kind."""
    scenes: dict[str, Street] = {}

    def scene(kind: str) -> Street:
        if kind not in scenes:
            prior = prior_of(kind)
            code = torch.linspace(0.8, -0.5, prior.num_codes, dtype=torch.float64)[None]
            scenes[kind] = street(prior, [(-0.8, 1.65, 9.0)], [0.5], code=code)
        return scenes[kind]

    return scene


def test_refinement_of_a_rendered_car_converges(kind: str, scene_of: Callable[[str], Street]) -> None:
    scene = scene_of(kind)
    detections = disturbed(scene.detections, 0.25, 0.08)
    result = DirectShapeRefiner(prior_of(kind), LIGHT)(scene.frames, detections)
    assert result.refined.all()
    assert (result.cost_after.sum(1) < result.cost_before.sum(1)).all()
    before, after = (T - scene.detections.T_cam_obj for T in (detections.T_cam_obj, result.T_cam_obj))
    assert after[:, :3, 3].norm() < 0.5 * before[:, :3, 3].norm()
    assert result.boxes().dimensions_hwl.isfinite().all()
    assert result.mesh(0).is_watertight


def test_the_autograd_jacobian_makes_the_same_steps(kind: str, scene_of: Callable[[str], Street]) -> None:
    scene = scene_of(kind)
    stages = tuple(replace(stage, max_iterations=2) for stage in LIGHT.stages)
    config = replace(LIGHT, stages=stages)
    by_autograd = replace(config, solver=replace(config.solver, jacobian="autograd"))
    detections = disturbed(scene.detections)
    hand, auto = (DirectShapeRefiner(prior_of(kind), c)(scene.frames, detections) for c in (config, by_autograd))
    torch.testing.assert_close(auto.T_cam_obj, hand.T_cam_obj, atol=1e-9, rtol=0)
    torch.testing.assert_close(auto.code, hand.code, atol=1e-9, rtol=0)


def test_gradients_through_the_refinement_reach_the_tensors_of_the_prior(
    kind: str, scene_of: Callable[[str], Street]
) -> None:
    """Two unrolled Gauss-Newton steps against differences of the whole refinement."""
    scene, name = scene_of(kind), "mean" if kind == "pca" else "layers.1.weight"
    config = replace(
        LIGHT,
        stages=(StageConfig(1.0, 0, 2),),
        photometric=replace(LIGHT.photometric, brightness="none"),
        solver=replace(LIGHT.solver, accept_every_step=True, initial_damping=0.0, rays="marched"),
        backward=BackwardConfig(mode="unroll", unroll_iterations=2),
    )

    def refined(step: float) -> tuple[Tensor, Tensor]:
        prior = copy.deepcopy(prior_of(kind))
        tensor = {**dict(prior.named_buffers()), **dict(prior.named_parameters())}[name]
        tensor.data.add_(step)
        tensor.requires_grad_()
        result = DirectShapeRefiner(prior, config)(scene.frames, disturbed(scene.detections))
        summary = result.T_cam_obj[0, :3, 3].sum() + result.code.sum()
        return summary.detach(), torch.autograd.grad(summary, tensor)[0].sum()

    step = 1e-6
    numeric = (refined(step)[0] - refined(-step)[0]) / (2 * step)
    _, by_autograd = refined(0.0)
    assert by_autograd.abs() > 1e-3
    # Of shapes that tell nothing but values, where a ray comes closest moves as parabolas 3 cm wide have it.
    torch.testing.assert_close(by_autograd, numeric, atol=0, rtol=1e-3 if kind == "pca" else 1e-2)
