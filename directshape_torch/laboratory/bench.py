"""The states of a regime with everything that is examined at them: pixels, terms of all forms, precise projections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.direct_terms import direct_terms
from directshape_torch.energy.projected_state import ProjectedState, ProjectedView
from directshape_torch.energy.term import Term
from directshape_torch.geometry import se3
from directshape_torch.laboratory.regimes import Regime, seeded
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.observation.packing import Observation, PixelSamples, pack_pixels
from directshape_torch.residuals.photometric import surface_slope
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.raycast import ObjectRays, Root

TERM_NAMES = (
    "silhouette_left", "silhouette_right", "silhouette_left_product", "silhouette_right_product", "photometric",
    "photometric_normalised", "shape", "height", "tilt_normal", "tilt_cosine", "dimensions", "pose",
)  # fmt: skip

# Brackets shrink superlinearly: more iterations than float64 can use; Newton's steps from there are quadratic.
ROOT_ITERATIONS = 20
_NEWTON_STEPS = 5
_CELLS_TO_CHOOSE_FROM = 3000
_CONTOUR = 3.0
_GRAZING_COSINE = 0.3


class _RememberedView(ProjectedView):
    """A view that finds each set of surface roots once: hundreds of displaced states start from them."""

    def __init__(self, view: ProjectedView) -> None:
        self.__dict__.update(view.__dict__)
        self._found: dict[int, tuple[Tensor, tuple[ObjectRays, Root]]] = {}

    def surface(self, rows: Tensor) -> tuple[ObjectRays, Root]:
        # The rows are kept beside what was found, so that no other tensor can take over their identity.
        if id(rows) not in self._found:
            self._found[id(rows)] = rows, super().surface(rows)
        return self._found[id(rows)][1]


@dataclass(frozen=True)
class Bench:
    """B states of one regime, ready to be examined.

    Attributes:
        regime: they were drawn from.
        problem: of these cars, its terms those of the default settings and the pose prior, the regime's stage begun.
        terms: by the laboratory's names, in all forms, the paper's among them.
        state: of the B cars.
        projected: at that state, with roots as precise as the dtype allows.
        cars: constants of the cars.
    """

    regime: Regime
    problem: CarProblem
    terms: dict[str, Term]
    state: CarState
    projected: ProjectedState
    cars: CarBatch

    @property
    def num_unknowns(self) -> int:
        return 6 + self.state.code.shape[1]

    @property
    def pixels_per_car(self) -> Tensor:
        """Pixels (B,) of both images."""
        sides = (self.problem.left, self.problem.right)
        count = torch.stack([torch.bincount(s.object_index, minlength=len(self.state.code)) for s in sides])
        return count.sum(dim=0)

    def moved(self, delta: Tensor) -> CarState:
        """All cars moved by one tangent vector (D,)."""
        return retract(self.state, delta.expand(len(self.state.code), self.num_unknowns))

    def project(self, state: CarState) -> ProjectedState:
        """The projection of another state; sample depths, closest approaches and hits stay, surfaces are followed."""
        return self.problem.project(state, frozen=self.projected, root_iterations=_NEWTON_STEPS)

    @classmethod
    def build(
        cls,
        scene: LaboratoryScene,
        prior: PCAShapePrior,
        regime: Regime,
        num_states: int,
        seed: int = 0,
        pixels_per_car: int = 64,
        config: RefinerConfig | None = None,
    ) -> Bench:
        """Draw states and choose their pixels."""
        config = _with_pose_prior(RefinerConfig() if config is None else config)
        generator = seeded(seed, regime)
        drawn = regime.draw(scene, prior, num_states, generator)
        cells = pixels_per_car if regime.pixels == "sampled" else _CELLS_TO_CHOOSE_FROM
        # Gradients of the image choose the pixels on both sides: there the residuals are not flat.
        sampling = replace(
            config.sampling, mode_right="as_left", min_pixels=cells, max_pixels=cells, occlusion=regime.occlusion
        )
        observation = pack_pixels(scene.frame, drawn.detections, sampling)
        cars = CarBatch.from_scene(scene.frame, drawn.detections)
        stage = config.stages[regime.stage]
        observation = _choose(observation, regime, prior, drawn.state, cars, stage, config, pixels_per_car, generator)
        other_forms = replace(
            config,
            silhouette=replace(config.silhouette, form="product"),
            photometric=replace(config.photometric, patch="normalised", brightness="affine"),
            priors=replace(config.priors, tilt_form="cosine"),
        )
        problem, other = (
            CarProblem(
                prior,
                direct_terms(c, prior, scene.frame, drawn.detections, cars, observation),
                observation.left,
                observation.right,
                c,
            )
            for c in (config, other_forms)
        )
        # Pixel sets are fixed where a refinement would begin, so that rows get lost on the way to the state.
        start = CarState(se3.inverse(drawn.detections.T_cam_obj), drawn.state.code)
        for p in (problem, other):
            p.begin_stage(stage, start)
        projected = problem.project(drawn.state, root_iterations=ROOT_ITERATIONS)
        projected.left, projected.right = _RememberedView(projected.left), _RememberedView(projected.right)
        return cls(regime, problem, _named(problem, other), drawn.state, projected, cars)


def _with_pose_prior(config: RefinerConfig) -> RefinerConfig:
    """With a stereo detector's standard deviations: without any that prior would not be there to be examined."""
    priors = replace(
        config.priors,
        pose_sigma_along_share=0.02,
        pose_sigma_across_m=0.1,
        pose_sigma_vertical_m=0.05,
        pose_sigma_yaw_deg=4.0,
    )
    return replace(config, priors=priors)


def _named(problem: CarProblem, other_forms: CarProblem) -> dict[str, Term]:
    by_name = {("tilt_normal" if t.name == "tilt" else t.name): t for t in problem.terms}
    for term in other_forms.terms:
        if term.name.startswith("silhouette"):
            by_name[f"{term.name}_product"] = term
        elif term.name == "photometric":
            by_name["photometric_normalised"] = term
        elif term.name == "tilt":
            by_name["tilt_cosine"] = term
    return {name: by_name[name] for name in TERM_NAMES}


def _choose(
    observation: Observation,
    regime: Regime,
    prior: PCAShapePrior,
    state: CarState,
    cars: CarBatch,
    stage: StageConfig,
    config: RefinerConfig,
    pixels_per_car: int,
    generator: torch.Generator,
) -> Observation:
    """The pixels that a regime is about, at most so many per car and side."""
    if regime.pixels == "sampled":
        return observation
    projected = ProjectedState(
        prior, state, observation.left, observation.right, config.silhouette.samples_per_ray, root_iterations=20
    )
    chosen = []
    for view, pixels in ((projected.left, observation.left), (projected.right, observation.right)):
        points = view.rays.at(view.closest_depth)
        sdf = projected.shape.value(points, pixels.object_index)
        rays, root = view.surface(torch.arange(len(pixels)))
        surface = rays.at(root.depth)
        if regime.pixels == "contour":
            zeta = (cars.focal_over_depth / stage.contour_width_px)[pixels.object_index]
            wanted = (zeta * sdf).abs() < _CONTOUR
        elif regime.pixels == "grazing":
            gradient = projected.shape.value_and_derivatives(surface, pixels.object_index).gradient
            wanted = root.found & surface_slope(gradient, rays.direction_obj, _GRAZING_COSINE)[1]
        else:
            wanted = _near_border(prior, points) | (root.found & _near_border(prior, surface))
        chosen.append(_at_most(pixels, wanted & view.march.crosses_bounds, pixels_per_car, generator))
    return replace(observation, left=chosen[0], right=chosen[1])


def _near_border(prior: PCAShapePrior, points_obj: Tensor) -> Tensor:
    lower, upper = prior.bounds_obj
    return torch.minimum(points_obj - lower, upper - points_obj).amin(dim=-1) < prior.spacing_m


def _at_most(pixels: PixelSamples, wanted: Tensor, count: int, generator: torch.Generator) -> PixelSamples:
    """Some of the wanted pixels of each object, drawn at random, in their order."""
    keep = torch.zeros_like(wanted)
    for car in range(int(pixels.object_index.max()) + 1 if len(pixels) else 0):
        rows = (wanted & (pixels.object_index == car)).nonzero()[:, 0]
        keep[rows[torch.randperm(len(rows), generator=generator)[:count]]] = True
    return pixels.select(keep.nonzero()[:, 0])
