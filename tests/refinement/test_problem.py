"""These tests check the energy of many cars: one cost, sums, independence of cars, stages, and steps."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from helpers.five_cars import five_cars
from helpers.problems import DEFAULT, PAPER, figures_at, left_of
from helpers.problems import begun_stage as begun_at
from helpers.synthetic_scene import cached_street, disturbed, select
from helpers.term_cases import case
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.geometry import se3
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.refinement.problem import CarMinimum, CarProblem, CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.solver.gauss_newton import minimise
from directshape_torch.state.cars import CarState
from directshape_torch.terms.term import Figures

DEMO = Path(__file__).parents[2] / "directshape_torch" / "assets" / "demo"
SETS = {"demo": "noisy_stereo", "rendered": "stereo", "kitti": "noisy_stereo"}


@pytest.fixture(autouse=True)
def no_graph() -> object:
    """The mode of the iterations, which differentiate nothing."""
    with torch.no_grad():
        yield


def begun_stage(config: RefinerConfig = DEFAULT, number: int = 1) -> tuple[CarStage, CarState]:
    """A stage of the five cars."""
    return begun_at(*five_cars(), config, number)


def _gradient_error(stage: CarStage, state: CarState, names: tuple[str, ...]) -> Tensor:
    """Relative error (B,) of the gradient by central differences of the cost, which looks anew at every state.

    If a ray changes between two of its minima within a step, the cost jumps; the smaller error of two steps avoids
    this.
    """
    of_terms = [number for number, name in enumerate(stage.problem.term_names) if name in names]
    analytic = figures_at(stage, state).gradient[:, of_terms].sum(dim=1)
    errors = []
    for step in (1e-6, 1e-7):
        numeric = torch.zeros_like(analytic)
        for unknown in range(analytic.shape[1]):
            delta = torch.zeros_like(analytic)
            delta[:, unknown] = step
            both = [state.unknowns.retract(state, sign * delta) for sign in (1, -1)]
            ends = [figures_at(stage, at).term_costs[:, of_terms].sum(1) for at in both]
            numeric[:, unknown] = (ends[0] - ends[1]) / (2 * step)
        errors.append((numeric - analytic).norm(dim=1) / analytic.norm(dim=1).clamp_min(1e-9))
    return torch.minimum(*errors)


def _first_frame_of(name: str) -> tuple[FrameBatch, Detections]:
    if name != "demo" and "DIRECTSHAPE_DATA" not in os.environ:
        pytest.skip("DIRECTSHAPE_DATA is not set: real frames needed")
    root = DEMO if name == "demo" else Path(os.environ["DIRECTSHAPE_DATA"]) / name
    masks = root / "training" / "masks"
    dataset = open_dataset("kitti", root, root / "detections" / SETS[name], masks, dtype=torch.float64)
    loaded = dataset.load(dataset.frame_ids[0])
    seen = loaded.detections.mask_left.dense().flatten(1).sum(dim=1) > 200
    return loaded.frame, select(loaded.detections, seen.nonzero()[:, 0])


def _ended(problem: CarProblem, state: CarState) -> CarMinimum[CarState]:
    return minimise(problem, state, problem.config.solver)


@pytest.mark.parametrize(
    "name", ["demo", *(pytest.param(name, marks=pytest.mark.long) for name in SETS if name != "demo")]
)
def test_the_cost_that_accepts_is_the_one_whose_gradient_made_it(name: str) -> None:
    """At the input and at the end; before, with the vertex of coarse samples: 5 percent in the median, 44 at most."""
    problem, state = DirectShapeRefiner(PCAShapePrior.load_bundled().double()).problem(*_first_frame_of(name))
    last = problem.begin(-1, problem.prepare(state))
    ended = _ended(problem, state)
    assert isinstance(ended.stage, CarStage)
    silhouettes = "silhouette_left", "silhouette_right"
    error = torch.cat([_gradient_error(*at, silhouettes) for at in ((last, state), (ended.stage, ended.end))])
    assert error.median() < 1e-7
    assert error.max() < 1e-2


@pytest.mark.parametrize(
    "regime", ["typical", "border", *(pytest.param(name, marks=pytest.mark.long) for name in ("near", "far"))]
)
def test_so_it_is_on_the_synthetic_street_for_all_terms(regime: str) -> None:
    stage, state = case(regime)
    assert _gradient_error(stage, state, stage.problem.term_names).max() < 1e-4


def test_tracked_rays_lead_where_marched_rays_lead() -> None:
    """To the same minimum from the same set of pixels, where every surface can be tracked."""
    ends = []
    for rays in ("tracked", "marched"):
        solver = replace(DEFAULT.solver, rays=rays, cost_tolerance=0.0, step_tolerance=1e-6)
        config = replace(DEFAULT, stages=(StageConfig(1.0, 0, 40),), solver=solver)
        prior, scene = cached_street()
        problem, state = DirectShapeRefiner(prior, config).problem(
            scene.frames, disturbed(scene.detections, 0.05, 0.02)
        )
        ends.append(se3.inverse(_ended(problem, state).end.T_obj_cam)[:, :3, 3])
    assert (ends[0] - ends[1]).norm(dim=1).max() < 1e-3


def _figures(frames: FrameBatch, detections: Detections) -> Figures:
    return figures_at(*begun_at(five_cars()[0], frames, detections))


@pytest.mark.parametrize("unknowns", ["pose", "shape"])
def test_unknowns_that_a_stage_holds_are_constant_in_it(unknowns: Literal["pose", "shape"]) -> None:
    config = replace(DEFAULT, stages=(replace(DEFAULT.stages[1], unknowns=unknowns),))
    stage, state = begun_stage(config, 0)
    _, held = stage.start(stage.problem.prepare(state))
    _, free = begun_stage(DEFAULT)[0].start(stage.problem.prepare(state))
    moving = torch.arange(9) < 6 if unknowns == "pose" else torch.arange(9) >= 6
    assert (held.gradient[:, ~moving] == 0).all()
    torch.testing.assert_close(held.gradient[:, moving], free.gradient[:, moving], rtol=1e-9, atol=1e-9)
    assert torch.equal(held.hessian[:, ~moving], torch.eye(9, dtype=torch.float64)[~moving].expand(5, -1, -1))
    assert torch.equal(stage.free_unknowns(state), moving.expand(5, -1))
    end = _ended(stage.problem, state).end
    if unknowns == "pose":
        assert torch.equal(end.code, state.code)
    else:
        torch.testing.assert_close(end.T_obj_cam, state.T_obj_cam, rtol=0, atol=1e-12)


def test_terms_are_those_with_a_weight() -> None:
    images, priors = ("silhouette_left", "silhouette_right", "photometric"), ("shape", "height", "tilt", "dimensions")

    def names(config: RefinerConfig) -> tuple[str, ...]:
        return begun_stage(config)[0].problem.term_names

    assert names(DEFAULT) == (*images, *priors)
    assert names(PAPER) == (*images, *priors[:3])
    assert case(config="combined")[0].problem.term_names == ("point_cloud", *images, *priors)
    assert names(replace(DEFAULT, silhouette=replace(DEFAULT.silhouette, weight=0.0)))[0] == "photometric"
    assert "photometric" not in names(replace(DEFAULT, photometric=replace(DEFAULT.photometric, weight=0.0)))


def _biased_street(bias_px: int, rows: int = 0) -> tuple[FrameBatch, Detections]:
    """The street for a rig whose right image is `bias_px` further left and `rows` lower."""
    scene = cached_street()[1]
    camera = scene.frames.camera
    height, width = scene.frames.images_left.shape[2:]

    def shifted(image: Tensor) -> Tensor:
        return torch.roll(torch.roll(image, -bias_px, dims=-1), rows, dims=-2)

    field = DisparityField.constant(
        float(bias_px), (width, height), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    ).to(dtype=torch.float64)
    vertical = torch.zeros_like(field.coefficients)
    vertical[0] = rows
    field = replace(field, vertical_coefficients=vertical)
    frames = replace(
        scene.frames,
        images_right=shifted(scene.frames.images_right),
        camera=replace(camera, disparity_field=field),
    )
    return frames, replace(scene.detections, mask_right=shifted(scene.detections.mask_right.dense()))


def test_a_field_that_is_known_brings_the_unbiased_energy_back() -> None:
    prior, scene = cached_street()
    plain = _figures(scene.frames, scene.detections)
    frames, detections = _biased_street(2, 1)
    known = _figures(frames, detections)
    camera = replace(frames.camera, disparity_field=None)
    unknown = _figures(replace(frames, camera=camera), detections)
    # Columns of pixels are lost at the image's border, and the field's rays are frozen at the input depth.
    torch.testing.assert_close(known.term_costs[:, :3], plain.term_costs[:, :3], rtol=0.1, atol=0.05)
    assert (unknown.cost > 2 * known.cost).all()
    stage, state = begun_at(prior, frames, detections)
    assert _gradient_error(stage, state, stage.problem.term_names).max() < 1e-4
    assert (left_of(stage).pixels.bias_px == 2).all()


def test_a_stage_follows_a_wider_contour_wherever_it_stands() -> None:
    """Two stages of one width are not the same stage: the first has nothing before it."""
    prior, scene = cached_street()
    widths = replace(DEFAULT, stages=tuple(StageConfig(contour_width_px=width) for width in (0.5, 2.0, 0.5)))
    problem, state = DirectShapeRefiner(prior, widths).problem(scene.frames, scene.detections)
    prepared = problem.prepare(state)
    assert [problem.begin(number, prepared).after_wider for number in (0, 1, 2, -1)] == [False, False, True, True]
