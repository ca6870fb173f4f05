"""`DirectShapeRefiner`: from frames and rough boxes to refined poses and shapes, in one batched Gauss-Newton."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Protocol

import torch
from torch import Tensor, nn

from directshape_torch.compile import compiling
from directshape_torch.config import RefinerConfig
from directshape_torch.errors import InputError, NoGradientWarning, SceneWarning
from directshape_torch.geometry import se3
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.gradient_mode import is_within_transform
from directshape_torch.numerics.records import kept
from directshape_torch.observation.extents import scene_extents
from directshape_torch.observation.packing import Observation, pack_pixels
from directshape_torch.observation.refinable import check_fit, check_no_tangents, refusals, without_empty_masks
from directshape_torch.refinement.outcome import Outcome
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.scene_problem import TermFactory, problem_of_scene
from directshape_torch.refinement.tracks import refined
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.gauss_newton import search_start
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.cars import CarBatch, CarState


class KnownRig(Protocol):
    """What is known of the rig that frames come from, `rig.estimate.RigEstimate`."""

    def corrected(self, frames: FrameBatch) -> FrameBatch:
        """Frames whose camera has the rig's disparity field."""
        ...

    def informed(self, frames: FrameBatch, detections: Detections) -> Detections:
        """Detections with the standard deviations of their depths, where they have none."""
        ...


class DirectShapeRefiner(nn.Module):
    """Refines pose and shape of cars in stereo frames (paper: DirectShape).

    Args:
        prior: family of shapes in any encoding; default the bundled grids of parametric cars. It is a submodule: its
            tensors move with `.to(...)` and live in the `state_dict`.
        config: settings; default `RefinerConfig()`, the same as `configs/default.yaml`.
        extra_terms: make terms of one's own for the cars of a call (docs/extra_terms.md), beside those of the method.
        rig: corrects frames that bring no disparity field of their own, and says how good the detector's depths are
            where nobody else does: a `RigEstimate`, which lives in the `state_dict` too.

    Raises:
        InputError: a prior without the members or derivatives that `ShapePrior` lists; settings that are no
            `RefinerConfig`; extra terms for the method "box_alignment".

    Examples:
        >>> refiner = DirectShapeRefiner()
        >>> refiner.prior.num_codes == refiner.prior.basis.shape[-1]
        True
    """

    def __init__(
        self,
        prior: ShapePrior | None = None,
        config: RefinerConfig | None = None,
        extra_terms: Sequence[TermFactory] = (),
        rig: KnownRig | None = None,
    ) -> None:
        super().__init__()
        if isinstance(prior, RefinerConfig):
            raise InputError("prior", "a ShapePrior", "RefinerConfig", "pass it as config=")
        if config is not None and not isinstance(config, RefinerConfig):
            raise InputError("config", "a RefinerConfig", repr(config), _config_cure(config))
        self.prior: ShapePrior = PCAShapePrior.load_bundled() if prior is None else prior
        self.config = RefinerConfig() if config is None else config
        self.extra_terms = tuple(extra_terms)
        self.rig = rig
        self._has_checked = self._has_warned = False
        if self.extra_terms and self.config.method == "box_alignment":
            raise InputError("extra_terms", "none with method box_alignment", f"{len(extra_terms)}", "choose direct")
        needs_graph = self.config.solver.jacobian == "autograd" or self.config.backward.mode != "none"
        if prior is not None or needs_graph:
            from directshape_torch.shape.check_prior import check_prior

            check_prior(self.prior, by_autograd=needs_graph)

    def forward(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None = None
    ) -> RefinementResult:
        """Refine every car of one or several frames.

        With `config.backward.mode` other than "none" pose and code of the result carry gradients to the masks, the
        images, the prior's tensors, the term weights, the disparity that the frames bring and the detector's standard
        deviations; to the input poses with "unroll", and in the other modes where there are such standard deviations.

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
                wanted of a prior that has none, or in forward mode; masks with values above 1.5.
            ConfigError: every term has weight zero.
            CompilationError: `compile: on` where something must be compiled and cannot be.
        """
        if torch.compiler.is_compiling():
            # One break in the graph of a compiled model around it: the loop decides by values all the time.
            return torch.compiler.disable(self._checked_refine)(frames, detections, term_weights)  # type: ignore[no-any-return, no-untyped-call]
        return self._checked_refine(frames, detections, term_weights)

    def _checked_refine(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None
    ) -> RefinementResult:
        frames, detections = self._with_rig(frames, detections)
        of_prior = (tensor for _, tensor in (*self.prior.named_buffers(), *self.prior.named_parameters()))
        check_no_tangents(frames, detections, (*(term_weights or {}).values(), *of_prior))
        self._warn_of(frames, detections)
        self._warn_without_gradient(frames, detections)
        differentiate = self.config.backward.mode != "none" and torch.is_grad_enabled()
        with (
            torch.set_grad_enabled(differentiate),
            full_precision(frames.images_left.device.type),
            compiling(self.config.compile, len(detections)),
        ):
            return self._refine(frames, detections, term_weights)

    def _warn_of(self, frames: FrameBatch, detections: Detections) -> None:
        """Mistakes that the tensors of this call show, as the setting `check` asks."""
        when = self.config.check
        is_due = when == "always" or (when == "first" and not self._has_checked)
        if not is_due or not len(detections) or is_within_transform():
            return
        # Here, for it is needed once in a process that asks for it.
        from directshape_torch.scene_check.check_scene import check_scene

        self._has_checked = True
        for finding in check_scene(frames, detections, match_images=False).findings:
            if finding.severity != "note":
                warnings.warn(str(finding), SceneWarning, stacklevel=6)

    def _warn_without_gradient(self, frames: FrameBatch, detections: Detections) -> None:
        """Once: a loss behind the result would train nothing before it, without a word."""
        if self._has_warned or self.config.backward.mode != "none" or not torch.is_grad_enabled():
            return
        inputs = (*frames.tensors("frames"), *detections.tensors("detections"))
        wanted = [each.name for each in inputs if each.value.requires_grad]
        if wanted:
            self._has_warned = True
            cure = "to train through the refiner set backward.mode=unroll, else call it under torch.no_grad()"
            warnings.warn(f"{', '.join(wanted)} get no gradient: {cure}", NoGradientWarning, stacklevel=6)

    def _refine(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None
    ) -> RefinementResult:
        seen = self._observe(frames, detections)
        failure = refusals(frames, detections, seen, self.config)
        usable = failure < 0
        rows = usable.nonzero()[:, 0]
        cars = self._cars(frames, detections).of_cars(usable)
        problem = problem_of_scene(
            self.config, self.prior, frames, detections, cars, seen.of_objects(usable), self.extra_terms, term_weights
        )
        # Detached: of cars that are not refined it is a value alone, and a NaN pose would have a NaN gradient here.
        state, status = self._input_state(detections.T_cam_obj.detach(), cars), failure
        outcome = Outcome.nothing(problem, CarState(*(part[:0] for part in state)))
        if len(rows):
            initial = self._input_state(detections.T_cam_obj.index_select(0, rows), cars)
            outcome = self._minimise(problem, initial, cars)
            state = CarState(*(full.index_copy(0, rows, part) for full, part in zip(state, outcome.state, strict=True)))
            status = status.index_copy(0, rows, outcome.status)
        return _assembled(self.prior, frames, detections, state, status, rows, outcome)

    def problem(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None = None
    ) -> tuple[CarProblem, CarState]:
        """The minimisation problem and the input state of these cars, for experiments; statuses are not checked."""
        frames, detections = self._with_rig(frames, detections)
        cars = self._cars(frames, detections)
        seen = self._observe(frames, detections)
        problem = problem_of_scene(
            self.config, self.prior, frames, detections, cars, seen, self.extra_terms, term_weights
        )
        return problem, self._input_state(detections.T_cam_obj, cars)

    def _with_rig(self, frames: FrameBatch, detections: Detections) -> tuple[FrameBatch, Detections]:
        """The call's inputs, checked, with what is known of the rig and the detector."""
        frames = frames if self.rig is None else self.rig.corrected(frames)
        check_fit(frames, detections, self.prior)
        if self.rig is None:
            return frames, detections
        # What the settings say of the detector wins.
        is_said = any(self.config.priors.pose_sigmas)
        return frames, detections if is_said else self.rig.informed(frames, detections)

    def _cars(self, frames: FrameBatch, detections: Detections) -> CarBatch:
        return CarBatch.from_scene(frames, detections, self.config.rig.disparity_sigma_px)

    def _input_state(self, T_cam_obj: Tensor, cars: CarBatch) -> CarState:
        code = self.prior.initial_code(len(T_cam_obj)).to(T_cam_obj)
        return CarState.of(se3.inverse(T_cam_obj), code, cars.num_offsets)

    def _observe(self, frames: FrameBatch, detections: Detections) -> Observation:
        """What the images show of all cars; stereo points for the methods that use them."""
        extents = scene_extents(detections)
        detections = without_empty_masks(detections, extents)
        seen = pack_pixels(frames, detections, self.config.sampling, extents)
        if self.config.method in ("direct", "box_alignment"):
            return seen
        from directshape_torch.stereo_matching.disparity import with_disparity
        from directshape_torch.terms.car_points import car_points

        matched = with_disparity(frames, needed=detections.frame_index)
        return replace(seen, points=car_points(matched, detections, self.config.point_cloud))

    def _minimise(self, problem: CarProblem, initial: CarState, cars: CarBatch) -> Outcome:
        if self.config.method == "box_alignment":
            from directshape_torch.refinement.box_alignment import align_boxes

            return align_boxes(problem, initial, cars)
        with torch.no_grad():
            start = search_start(problem, initial, cars.search_moves(self.config.search))
        return refined(problem, cars, initial, start)


def _config_cure(config: object) -> str:
    """How to come to settings from what was given instead of them."""
    if isinstance(config, (str, PurePath)):
        return f'pass config=load_config("{config}")'
    return 'pass config=load_config("fast"), or config_from_mapping(RefinerConfig, ...) of nested keys'


def _assembled(
    prior: ShapePrior,
    frames: FrameBatch,
    detections: Detections,
    state: CarState,
    status: Tensor,
    rows: Tensor,
    outcome: Outcome,
) -> RefinementResult:
    """The result of a call whose cars `rows` were minimised; the others keep what they came with."""
    of_all = outcome.spread(rows, len(detections))
    refined = is_refined(status)
    returned_input = (status == Status.not_trusted.code) | (status == Status.no_evidence.code)
    figures_known = refined | returned_input
    # The input pose is returned to the bit for cars that were not refined, not inverted twice.
    T_cam_obj = torch.where(refined[:, None, None], se3.inverse(state.T_obj_cam), detections.T_cam_obj)
    return RefinementResult(
        T_cam_obj=T_cam_obj,
        code=state.code,
        status_code=status,
        iterations=of_all.iterations.clamp_min(0),
        term_names=outcome.term_names,
        cost_before=of_all.cost_before,
        cost_after=of_all.cost_after,
        covariance=kept(of_all.covariance, refined),
        covariance_xyz_yaw=kept(of_all.covariance_xyz_yaw, refined),
        cost_history=of_all.cost_history,
        quality=of_all.quality.where(figures_known),
        observability=of_all.observability.where(refined),
        profile=of_all.profile.where(figures_known),
        # The caller may reuse the tensor for the next call.
        input_dimensions_hwl=detections.dimensions_hwl.clone(),
        ground_source=_ground_sources(frames, detections),
        t_cam_ref=frames.camera.t_cam_ref[detections.frame_index],
        track_part=of_all.track_part,
        prior=prior,
        has_shape=outcome.has_shape,
    )


def _ground_sources(frames: FrameBatch, detections: Detections) -> tuple[str, ...]:
    """Where the plane of each car's frame came from; which frame that is the host asks only where it matters."""
    sources = frames.ground.source
    if len(set(sources)) == 1:
        return sources[:1] * len(detections)
    return tuple(sources[frame] for frame in detections.frame_index.tolist())
