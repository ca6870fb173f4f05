"""`DirectShapeRefiner`: from frames and rough boxes to refined poses and shapes, in one batched Gauss-Newton."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from directshape_torch.backward import attached_state
from directshape_torch.config import AcceptanceConfig, RefinerConfig
from directshape_torch.covariance import covariance_of, covariance_xyz_yaw
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.direct_terms import stacked_weights
from directshape_torch.energy.method import method_terms
from directshape_torch.errors import InputError
from directshape_torch.evidence import Course
from directshape_torch.geometry import se3
from directshape_torch.initial_search import search_start
from directshape_torch.observability import Observability, observability_of
from directshape_torch.observation.packing import Observation, pack_pixels
from directshape_torch.observation.regions import MASK_THRESHOLD
from directshape_torch.quality import FitQuality, fit_quality
from directshape_torch.result import RefinementResult
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.check_prior import check_prior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.solver.problem import where_rows
from directshape_torch.status import Status
from directshape_torch.stereo_matching.car_points import PointSamples, car_points
from directshape_torch.stereo_matching.dense_disparity import with_disparity
from directshape_torch.trust_model import bundled_trust_model

# A car whose origin is nearer than this is at the camera: its silhouette is not a projection any more.
_MIN_DEPTH_M = 1.0


class DirectShapeRefiner(nn.Module):
    """Refines pose and shape of cars in stereo frames (paper: DirectShape).

    Args:
        prior: family of shapes in any encoding; default the bundled grids of parametric cars. It is a submodule: its
            tensors move with `.to(...)` and live in the `state_dict`.
        config: settings; default `RefinerConfig()`, the same as `configs/default.yaml`.

    Raises:
        InputError: a prior without the members or derivatives that `ShapePrior` lists.

    Example:
        >>> refiner = DirectShapeRefiner()
        >>> refiner.prior.num_codes == refiner.prior.basis.shape[-1]
        True
    """

    def __init__(self, prior: ShapePrior | None = None, config: RefinerConfig | None = None) -> None:
        super().__init__()
        self.prior: ShapePrior = PCAShapePrior.load_bundled() if prior is None else prior
        self.config = RefinerConfig() if config is None else config
        needs_graph = self.config.solver.jacobian == "autograd" or self.config.backward.mode != "none"
        check_prior(self.prior, by_autograd=needs_graph)

    def forward(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None = None
    ) -> RefinementResult:
        """Refine every car of one or several frames.

        With `config.backward.mode` other than "none" pose and code of the result carry gradients to the masks, the
        images, the prior's tensors, the term weights and the disparity that the frames bring, with "unroll" to the
        input poses as well.

        Args:
            frames: F frames; dtype and device must be those of the prior.
            detections: B cars in any order.
            term_weights: (B,) factors of named terms for each car, beside the weights of the configuration: how far a
                network trusts each of them.

        Returns:
            Poses, shapes, statuses, costs and covariances, in the order of the detections. Cars that cannot be refined
            keep their input pose and say why; they touch no other car.

        Raises:
            InputError: frames, detections and prior do not fit together; a term that does not exist; gradients are
                wanted of a prior that has none.
        """
        if torch.compiler.is_compiling():
            # One break in the graph of a compiled model around it: the loop decides by values all the time.
            return torch.compiler.disable(self._checked_refine)(frames, detections, term_weights)  # type: ignore[no-any-return, no-untyped-call]
        return self._checked_refine(frames, detections, term_weights)

    def _checked_refine(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None
    ) -> RefinementResult:
        _check_fit(frames, detections, self.prior)
        differentiate = self.config.backward.mode != "none" and torch.is_grad_enabled()
        # Half precision cannot hold pixel coordinates: under autocast everything here stays in the inputs' precision.
        with torch.set_grad_enabled(differentiate), torch.autocast(frames.images_left.device.type, enabled=False):
            return self._refine(frames, detections, term_weights)

    def _refine(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None
    ) -> RefinementResult:
        # Detached: of cars that are not refined it is a value alone, and a NaN pose would have a NaN gradient here.
        input_state = CarState(se3.inverse(detections.T_cam_obj.detach()), self._initial_code(detections))
        points = self._points(frames, detections)
        observation, failure = self._observe(frames, detections, points)
        usable = failure < 0
        rows = usable.nonzero()[:, 0]
        state, status = input_state, failure.clone()
        outcome = None
        if len(rows):
            outcome = self._minimise(frames, detections, (observation, points), usable, term_weights)
            state = CarState(*(full.index_copy(0, rows, part) for full, part in zip(state, outcome.state, strict=True)))
            status = status.index_copy(0, rows, outcome.status)
        return _assemble(self.prior, frames, detections, state, status, rows, outcome)

    def problem(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None = None
    ) -> tuple[CarProblem, CarState]:
        """The minimisation problem and the input state of these cars, for experiments; statuses are not checked."""
        _check_fit(frames, detections, self.prior)
        detections = _without_empty_masks(detections, _mask_areas(detections))
        observation = pack_pixels(frames, detections, self.config.sampling)
        cars = CarBatch.from_scene(frames, detections)
        points = self._points(frames, detections)
        terms = method_terms(self.config, self.prior, frames, detections, cars, observation, points)
        state = CarState(se3.inverse(detections.T_cam_obj), self._initial_code(detections))
        weights = stacked_weights(term_weights, terms, state.code)
        return CarProblem(self.prior, terms, observation.left, observation.right, self.config, weights), state

    def _initial_code(self, detections: Detections) -> Tensor:
        return self.prior.initial_code(len(detections)).to(detections.T_cam_obj)

    def _points(self, frames: FrameBatch, detections: Detections) -> PointSamples | None:
        """Stereo points of all cars, for the methods that use them."""
        if self.config.method == "direct" or not len(detections):
            return None
        detections = _without_empty_masks(detections, _mask_areas(detections))
        cloud = self.config.point_cloud
        return car_points(with_disparity(frames, cloud.matcher), detections, cloud)

    def _observe(
        self, frames: FrameBatch, detections: Detections, points: PointSamples | None
    ) -> tuple[Observation | None, Tensor]:
        """Packed pixels of all cars and, for each car, the code of the status that forbids its refinement, or -1."""
        code = torch.full((len(detections),), -1, device=detections.T_cam_obj.device)
        if not len(detections):
            return None, code
        T = detections.T_cam_obj
        finite = T.isfinite().all(-1).all(-1)
        upright = (T[:, :3, 1] * frames.ground.normal[detections.frame_index]).sum(-1) < 0
        in_front = finite & (T[:, 2, 3] > _MIN_DEPTH_M) & upright
        areas = _mask_areas(detections)
        detections = _without_empty_masks(detections, areas)
        has_mask = detections.has_mask_left | detections.has_mask_right
        observation = pack_pixels(frames, detections, self.config.sampling)
        left, right = (
            torch.bincount(x.object_index, minlength=len(detections)) for x in (observation.left, observation.right)
        )
        # A region always has pixels, but masks that show next to nothing cannot tell a car from its surroundings.
        too_few = torch.minimum(left + right, areas.sum(dim=1)) < self.config.sampling.min_usable_pixels
        lacking = [(too_few, Status.too_few_pixels), (~has_mask, Status.no_mask)]
        if self.config.method == "geometric" and points is not None:
            lacking = [(points.counts < self.config.point_cloud.min_points, Status.too_few_points)]
        for condition, status in (
            *lacking,
            (~in_front, Status.behind_camera),
            (~finite, Status.non_finite),
        ):
            code = torch.where(condition, torch.full_like(code, status.code), code)
        return observation, code

    def _minimise(
        self,
        frames: FrameBatch,
        detections: Detections,
        seen_by_all: tuple[Observation | None, PointSamples | None],
        usable: Tensor,
        term_weights: Mapping[str, Tensor] | None,
    ) -> _Outcome:
        observation, points = seen_by_all
        assert observation is not None
        seen = observation.of_objects(usable)
        cars = CarBatch.from_scene(frames, detections).of_objects(usable)
        points = None if points is None else points.of_objects(usable)
        terms = method_terms(self.config, self.prior, frames, detections, cars, seen, points)
        weights = stacked_weights(term_weights, terms, self._initial_code(detections))
        problem = CarProblem(
            self.prior, terms, seen.left, seen.right, self.config, None if weights is None else weights[usable]
        )
        T_cam_obj = detections.T_cam_obj[usable]
        initial = CarState(se3.inverse(T_cam_obj), self.prior.initial_code(len(T_cam_obj)).to(T_cam_obj))
        record = torch.is_grad_enabled() and self.config.backward.mode == "unroll"
        with torch.no_grad():
            start = search_start(problem, initial, cars, self.config.search)
            minimum = minimise(problem, initial, self.config.solver, start, record)
            outcome = _outcome_of(problem, initial, minimum, cars.detector_hwl)
            minimum = _without_distrusted(minimum, initial, outcome.quality, self.config.acceptance)
            outcome = replace(outcome, status=minimum.status)
        state = attached_state(problem, initial, start, minimum, self.config, cars.detection_row)
        return replace(outcome, state=state)


@dataclass(frozen=True)
class _Outcome:
    """Result of the cars that could be refined."""

    state: CarState
    status: Tensor
    iterations: Tensor
    cost_history: Tensor
    term_names: tuple[str, ...]
    cost_before: Tensor
    cost_after: Tensor
    covariance: Tensor
    covariance_xyz_yaw: Tensor
    quality: FitQuality
    observability: Observability


def _outcome_of(problem: CarProblem, initial: CarState, minimum: Minimum[CarState], detector_hwl: Tensor) -> _Outcome:
    linearisations = problem.linearise_terms(minimum.state, with_fisher=True)
    covariance = covariance_of(linearisations)
    unseen = observability_of(problem.prior, minimum.state, problem.terms, linearisations)
    course = Course(
        before=initial,
        after=minimum.state,
        detector_hwl=detector_hwl,
        cost_before=problem.term_costs(initial),
        cost_after=torch.stack([part.cost for part in linearisations], dim=1),
        linearisations=linearisations,
        covariance=covariance,
        covariance_xyz_yaw=covariance_xyz_yaw(covariance, minimum.state.T_obj_cam),
        unsettled=minimum.status == Status.max_iterations.code,
    )
    return _Outcome(
        minimum.state,
        minimum.status,
        minimum.iterations,
        minimum.cost_history,
        tuple(term.name for term in problem.terms),
        course.cost_before,
        course.cost_after,
        covariance,
        course.covariance_xyz_yaw,
        fit_quality(problem, course),
        # The directions are mostly those of the depth, so its factor brings them to size.
        unseen.scaled(bundled_trust_model().sigma_factors[0]),
    )


def _without_distrusted(
    minimum: Minimum[CarState], initial: CarState, quality: FitQuality, limits: AcceptanceConfig
) -> Minimum[CarState]:
    """The input's state for cars whose result is too likely to be worse; unknown probabilities are no reason."""
    doubtful = quality.probability_better < limits.min_probability_better
    risky = quality.probability_not_worse < limits.min_probability_not_worse
    distrusted = _is_refined(minimum.status) & (doubtful | risky)
    status = torch.where(distrusted, torch.full_like(minimum.status, Status.not_trusted.code), minimum.status)
    return replace(minimum, state=where_rows(distrusted, initial, minimum.state), status=status)


def _no_outcome(state: CarState, unknowns: int) -> _Outcome:
    """The outcome of no cars at all."""
    nothing = state.code.new_zeros(0, 0, dtype=torch.float64)
    none = nothing.long()[:, 0:0].reshape(0)
    square = nothing.reshape(0, unknowns, unknowns)
    xyz_yaw = nothing.reshape(0, 4, 4)
    quality = FitQuality.nothing(nothing, 0)
    empty = CarState(state.T_obj_cam[:0], state.code[:0])
    unseen = Observability.nothing(nothing, 0)
    return _Outcome(empty, none, none, nothing, (), nothing, nothing, square, xyz_yaw, quality, unseen)


def _is_refined(status: Tensor) -> Tensor:
    return (status == Status.converged.code) | (status == Status.max_iterations.code)


def _mask_areas(detections: Detections) -> Tensor:
    """Foreground pixels (B, 2) of the left and right masks, zero where absent; NaN counts, to be noticed later."""
    masks = (detections.mask_left, detections.mask_right)
    areas = torch.stack([(~(mask <= MASK_THRESHOLD)).flatten(1).sum(dim=1) for mask in masks], dim=1)
    return areas * torch.stack([detections.has_mask_left, detections.has_mask_right], dim=1)


def _without_empty_masks(detections: Detections, areas: Tensor) -> Detections:
    """A mask without any foreground counts as none: it would only say that there is no car."""
    left, right = (areas > 0).unbind(dim=1)
    return replace(detections, has_mask_left=left, has_mask_right=right)


def _check_fit(frames: FrameBatch, detections: Detections, prior: ShapePrior) -> None:
    for name, tensor in (("frames", frames.images_left), ("detections", detections.T_cam_obj)):
        if tensor.dtype != prior.origin.dtype or tensor.device != prior.origin.device:
            raise InputError(
                name,
                f"dtype {prior.origin.dtype} on {prior.origin.device}, like the refiner",
                f"{tensor.dtype} on {tensor.device}",
                "move them together with .to(device, dtype)",
            )
    if len(detections):
        if detections.mask_left.shape[1:] != frames.images_left.shape[2:]:
            raise InputError(
                "detections.mask_left",
                f"masks of the (padded) image size {tuple(frames.images_left.shape[2:])}",
                f"{tuple(detections.mask_left.shape[1:])}",
            )
        lowest, highest = int(detections.frame_index.min()), int(detections.frame_index.max())
        if lowest < 0 or highest >= len(frames):
            raise InputError("detections.frame_index", f"0..{len(frames) - 1}", f"{lowest}..{highest}")


def _assemble(
    prior: ShapePrior,
    frames: FrameBatch,
    detections: Detections,
    state: CarState,
    status: Tensor,
    rows: Tensor,
    outcome: _Outcome | None,
) -> RefinementResult:
    count, unknowns = len(detections), 6 + prior.num_codes
    if outcome is None:
        outcome = _no_outcome(state, unknowns)

    def spread(part: Tensor) -> Tensor:
        full = torch.full((count, *part.shape[1:]), torch.nan, dtype=torch.float64, device=status.device)
        return full.index_copy(0, rows, part.to(torch.float64))

    def only_refined(values: Tensor) -> Tensor:
        return torch.where(refined[:, None, None], values, torch.full_like(values, torch.nan))

    iterations = torch.zeros(count, dtype=torch.long, device=status.device).index_copy(0, rows, outcome.iterations)
    refined = _is_refined(status)
    # The input pose is returned to the bit for cars that were not refined, not inverted twice.
    T_cam_obj = torch.where(refined[:, None, None], se3.inverse(state.T_obj_cam), detections.T_cam_obj)
    return RefinementResult(
        T_cam_obj=T_cam_obj,
        code=state.code,
        status_code=status,
        iterations=iterations,
        term_names=outcome.term_names,
        cost_before=spread(outcome.cost_before),
        cost_after=spread(outcome.cost_after),
        covariance=only_refined(spread(outcome.covariance)),
        covariance_xyz_yaw=only_refined(spread(outcome.covariance_xyz_yaw)),
        cost_history=spread(outcome.cost_history),
        quality=outcome.quality.spread(rows, count).where(refined | (status == Status.not_trusted.code)),
        observability=outcome.observability.spread(rows, count).where(refined),
        input_dimensions_hwl=detections.dimensions_hwl,
        ground_source=tuple(frames.ground.source[f] for f in detections.frame_index.tolist()),
        t_cam_ref=frames.camera.t_cam_ref[detections.frame_index],
        prior=prior,
    )
