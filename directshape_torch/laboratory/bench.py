"""This module prepares the states of a regime with everything that is examined at them: pixels, terms and rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.io.config_files import load_config
from directshape_torch.laboratory.regimes import Draw, Regime, seeded
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.numerics.tables import Chosen, take_rows
from directshape_torch.numerics.tensors import length, occurrences
from directshape_torch.observation.packing import Observation, pack_pixels
from directshape_torch.refinement.problem import CarProblem, CarStage
from directshape_torch.refinement.scene_problem import TermFactory, problem_of_scene
from directshape_torch.rows import PixelSamples, PointSamples, Rays, Rows
from directshape_torch.scene.detections import Detections
from directshape_torch.shape.field import field_of
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.state.unknowns import State
from directshape_torch.terms.check_term import car_products, check_same
from directshape_torch.terms.depth import closest_of_march, first_hits, march
from directshape_torch.terms.silhouette import contour_zeta
from directshape_torch.terms.term import AnchorT, AnyTerm, Linear, Prepared, Term, linear_of
from directshape_torch.tracks.next_view import NEXT_VIEW_NAME
from directshape_torch.tracks.path import MOTION_NAMES, timed
from directshape_torch.tracks.share import in_tracks
from directshape_torch.tracks.state import TrackState, own_and_shared

TERM_NAMES = (
    "silhouettes", "silhouettes_product", "photometric", "point_cloud",
    "shape", "height", "tilt_normal", "tilt_cosine", "dimensions", "pose",
)  # fmt: skip
TRACK_NAMES = (*MOTION_NAMES, NEXT_VIEW_NAME)
"""These terms of views of a track exist only in the regime of a track."""

# Each evaluation begins where the previous one ended, so that tracked depths converge to the last digit.
_ROUNDS = 3
_CELLS_TO_CHOOSE_FROM = 3000
_CONTOUR = 3.0
_GRAZING_COSINE = 0.3
_POINT_NOISE_M = 0.05


@dataclass(frozen=True)
class Bench:
    """These are B states of one regime, ready to be examined."""

    regime: Regime  # the regime of the states
    stage: CarStage  # begun, with default settings, a pose prior, points and the user's own terms
    terms: Mapping[str, AnyTerm]  # by the laboratory's names, in all forms including the paper's
    state: CarState | TrackState  # of the B cars
    prepared: Prepared  # what the rays see of the state
    rows: Mapping[str, Linear[Any]]  # residuals and factors of each term at the state

    @property
    def problem(self) -> CarProblem:
        return self.stage.problem

    @property
    def num_unknowns(self) -> int:
        return self.state.unknowns.size

    @property
    def rays_per_car(self) -> Tensor:
        """Number of rays (B,) of each car in both images."""
        masks, count = self.problem.masks, torch.zeros_like(self.state.code[:, 0])
        return count.index_add(0, masks.rays.owner, masks.filled.sum(dim=1))

    def moved(self, delta: Tensor) -> CarState | TrackState:
        """The state with all cars moved by one tangent vector (D,)."""
        return self.state.unknowns.retract(self.state, delta.expand(len(self.state.code), self.num_unknowns))

    @classmethod
    def build(
        cls,
        scene: LaboratoryScene,
        prior: PCAShapePrior,
        regime: Regime,
        num_states: int,
        seed: int = 0,
        pixels_per_car: int = 64,
        own_terms: Sequence[TermFactory] = (),
    ) -> Bench:
        """Draw states and choose their pixels."""
        config = _settings(regime, pixels_per_car)
        generator = seeded(seed, regime)
        drawn = regime.draw(Draw(scene, prior, num_states, generator))
        frame, detections = scene.frame, drawn.detections
        cars = CarBatch.from_scene(frame, detections)
        observation = pack_pixels(frame, detections, config.sampling)
        if regime.pixels != "sampled":
            observation = _chosen(observation, regime, prior, drawn.state, cars, config, pixels_per_car, generator)
        seen = replace(observation, points=_points(observation.left, drawn.state, generator))
        other_forms = replace(
            config,
            silhouette=replace(config.silhouette, form="product"),
            priors=replace(config.priors, tilt_form="cosine"),
        )
        # Pixel sets are fixed where a refinement would begin, so that some rows are lost between there and the state.
        no_offset = torch.zeros_like(drawn.state.offset_px)
        start = drawn.state._replace(T_obj_cam=se3.inverse(detections.T_cam_obj), offset_px=no_offset)
        stages = []
        for c in (config, other_forms):
            problem = problem_of_scene(c, prior, frame, detections, cars, seen, own_terms)
            if isinstance(drawn.state, TrackState):
                problem = _of_a_track(problem, cars, drawn.state.alone)
            # A track has only the last stage.
            number = min(regime.stage, len(problem.stages()) - 1)
            stages.append(problem.begin(number, problem.prepare(start)))
        if own_terms:
            _check_refused(config, prior, scene, detections, cars, seen, own_terms)
        terms = _named(*stages)
        prepared = stages[0].problem.prepare(drawn.state)
        rows = {name: rows_at(term, prior, prepared) for name, term in terms.items()}
        return cls(regime, stages[0], terms, drawn.state, prepared, rows)


@torch.no_grad()
def rows_at(term: Term[AnchorT], prior: ShapePrior, prepared: Prepared) -> Linear[AnchorT]:
    """The rows of a term at a state, with depths as precise as the dtype allows."""
    at = linear_of(term, prior, prepared.field, prepared.state, term.anchor(prepared))
    for _ in range(_ROUNDS):
        at = linear_of(term, prior, prepared.field, prepared.state, at.anchor)
    return at


def _settings(regime: Regime, pixels_per_car: int) -> RefinerConfig:
    """The default settings with every prior and few pixels."""
    config = load_config("combined")
    # These are a stereo detector's standard deviations. Without them there would be no pose prior to examine.
    priors = replace(
        config.priors,
        pose_sigma_along_share=0.02,
        pose_sigma_across_m=0.1,
        pose_sigma_vertical_m=0.05,
        pose_sigma_yaw_deg=4.0,
    )
    cells = pixels_per_car if regime.pixels == "sampled" else _CELLS_TO_CHOOSE_FROM
    # Image gradients choose the pixels on both sides, because residuals have a slope there.
    sampling = replace(
        config.sampling, mode_right="adaptive", min_pixels=cells, max_pixels=cells, occlusion=regime.occlusion
    )
    cloud = replace(config.point_cloud, min_points=1)
    return replace(config, priors=priors, sampling=sampling, point_cloud=cloud)


def _check_refused(
    config: RefinerConfig,
    prior: PCAShapePrior,
    scene: LaboratoryScene,
    detections: Detections,
    cars: CarBatch,
    seen: Observation,
    own_terms: Sequence[TermFactory],
) -> None:
    """Raise `InputError` unless a user's terms give equal values for cars with and without the first car."""
    everyone, others = (Chosen.where(torch.arange(len(cars)) > car) for car in (-1, 0))
    all_cars, few = (
        problem_of_scene(config, prior, scene.frame, detections, cars.of(kept), seen.of(kept), own_terms)
        for kept in (everyone, others)
    )
    for before, now in zip(all_cars.of(others).extra_terms, few.extra_terms, strict=True):
        code = prior.initial_code(len(cars) - 1).to(cars.detector_T_cam_obj)
        state = CarState.of(se3.inverse(cars.detector_T_cam_obj[others.index]), code, cars.num_offsets)
        prepared = few.prepare(state)
        stage = config.stages[0]
        products = [
            car_products(term, prior, prepared.field, state, term.anchor(prepared))
            for term in (before.begin(stage, prepared), now.begin(stage, prepared))
        ]
        called = f"extra term {now.names[0]!r} of the cars that were not refused"
        check_same(called, products[1], products[0], range(len(cars) - 1))


def _of_a_track(problem: CarProblem, cars: CarBatch, state: CarState) -> CarProblem:
    """The problem of cars as views of one track, 0.1 s apart, from a camera that drives a curve."""
    number = torch.arange(len(cars))
    time_s = 0.1 * number.to(state.code)
    T_world_cam = se3.exp(time_s[:, None] * time_s.new_tensor([0.5, 0.0, 10.0, 0.0, 0.2, 0.0]))
    sharing = Groups.from_numbers([0] * len(cars), *own_and_shared(state))
    views = timed(sharing, replace(cars, time_s=time_s, T_world_cam=T_world_cam))
    return in_tracks(problem, sharing, views, state, sharing.all_members, (number + 1).clamp_max(len(cars) - 1))


def _named(stage: CarStage, other_forms: CarStage) -> dict[str, AnyTerm]:
    """The terms of a stage by name, with the other forms of two of them; a user's terms keep their names."""
    plain, other = (
        {"silhouettes" if len(t.names) > 1 else t.names[0]: t for t in s.terms} for s in (stage, other_forms)
    )
    plain |= {"tilt_normal": plain.pop("tilt"), "tilt_cosine": other["tilt"]}
    plain |= {"silhouettes_product": other["silhouettes"]}
    return {name: plain.pop(name) for name in TERM_NAMES} | plain


def _points(pixels: PixelSamples, state: State, generator: torch.Generator) -> PointSamples:
    """Points near the middle of their cars, one on the ray of each left pixel."""
    car = pixels.object_index
    depth = se3.inverse(state.T_obj_cam)[car, 2, 3]
    noise = torch.randn(len(car), 3, generator=generator, dtype=torch.float64)
    points = pixels.origin_cam + depth[:, None] * pixels.ray_cam + _POINT_NOISE_M * noise
    return PointSamples(car, points, occurrences(car, len(state.code)))


def _chosen(
    observation: Observation,
    regime: Regime,
    prior: PCAShapePrior,
    state: State,
    cars: CarBatch,
    config: RefinerConfig,
    pixels_per_car: int,
    generator: torch.Generator,
) -> Observation:
    """The pixels that a regime is about, at most `pixels_per_car` for each car and side."""
    field, bounds = field_of(prior.bind(state.code)), prior.bounds_obj
    zeta = contour_zeta(cars, config.stages[regime.stage])
    chosen = []
    for pixels in (observation.left, observation.right):
        rows = Rows.of_sorted(pixels.object_index, len(cars))
        owner = rows.blocks.owner
        rays = Rays.of_rows(rows, pixels.origin_cam, pixels.ray_cam).in_objects(state.T_obj_cam)
        marched = march(field, owner, rays, bounds, config.silhouette.samples_per_ray)
        closest = closest_of_march(field, owner, rays, bounds, marched)
        hits = first_hits(field, owner, rays, marched, closest)
        if regime.pixels == "contour":
            sdf = field.sdf(closest.points_obj, owner)
            wanted = (zeta[owner][:, None] * sdf).abs() < _CONTOUR
        elif regime.pixels == "grazing":
            slope = (hits.normal_obj * rays.direction_obj).sum(0).abs()
            steepest = length(hits.normal_obj, dim=0) * length(rays.direction_obj, dim=0)
            wanted = hits.found & (slope <= _GRAZING_COSINE * steepest)
        else:
            wanted = near_border(prior, closest.points_obj) | (hits.found & near_border(prior, hits.points_obj))
        wanted = (wanted & closest.crosses).flatten()[rows.places]
        chosen.append(_at_most(pixels, wanted, pixels_per_car, generator))
    return replace(observation, left=chosen[0], right=chosen[1])


def near_border(prior: PCAShapePrior, points_obj: Tensor) -> Tensor:
    """Whether points (3, ...) lie within a cell of the border of a prior's grid."""
    lower, upper = (corner.view(3, *[1] * (points_obj.ndim - 1)) for corner in prior.bounds_obj)
    return torch.minimum(points_obj - lower, upper - points_obj).amin(dim=0) < prior.spacing_m


def _at_most(pixels: PixelSamples, wanted: Tensor, count: int, generator: torch.Generator) -> PixelSamples:
    """At most `count` wanted pixels of each car, drawn at random, in their original order."""
    keep = torch.zeros_like(wanted)
    for car in set(pixels.object_index.tolist()):
        rows = (wanted & (pixels.object_index == car)).nonzero()[:, 0]
        keep[rows[torch.randperm(len(rows), generator=generator)[:count]]] = True
    return take_rows(pixels, keep.nonzero()[:, 0], "P")
