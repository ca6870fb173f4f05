"""`DirectShapeRefiner` refines poses and shapes from frames and rough boxes in one batched Gauss-Newton."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from directshape_torch.compile import compiling
from directshape_torch.config import RefinerConfig
from directshape_torch.errors import InputError, NoGradientWarning, SceneWarning
from directshape_torch.geometry import se3
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.gradient_mode import is_plain
from directshape_torch.numerics.tables import Chosen
from directshape_torch.observation.packing import Observation, pack_pixels
from directshape_torch.observation.refinable import fitting, refusals
from directshape_torch.refinement.fusion import UNKNOWN_DETECTOR, fused, noise_of_boxes
from directshape_torch.refinement.make_result import unrefined_result
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.refined import Refined
from directshape_torch.refinement.rescue import searched
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.scene_problem import TermFactory, problem_of_scene
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch, CarState

if TYPE_CHECKING:
    from directshape_torch.rig.estimate import RigEstimate
    from directshape_torch.rig.rigs import RigEstimates


class DirectShapeRefiner(nn.Module):
    """This `nn.Module` refines pose and shape of cars in stereo frames (paper: DirectShape).

    Args:
        prior: family of shapes in any encoding. Default: the bundled grids of parametric cars. The prior is a
            submodule, so its tensors move with `.to(...)` and live in the `state_dict`.
        config: settings. Default: `RefinerConfig()`, which equals `configs/default.yaml`.
        extra_terms: factories of a user's own terms for the cars of a call (docs/extra_terms.md), in addition to the
            terms of the settings.
        rig: a `RigEstimate`, which lives in the `state_dict` too. It corrects frames that bring no disparity field of
            their own, and says how good the detector's depths and its own field are if frames and detections do not say
            it. Without a rig, cameras may be off by `config.rig.disparity_sigma_px`, and the detector is taken to be as
            good as most detectors.

    Raises:
        InputError: a prior without the members or derivatives that `ShapePrior` lists; settings that are no
            `RefinerConfig`.

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
        rig: RigEstimate | RigEstimates | None = None,
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
        needs_graph = self.config.solver.jacobian == "autograd" or self.config.backward.mode != "none"
        if prior is not None or needs_graph:
            from directshape_torch.shape.check_prior import check_prior

            check_prior(self.prior, by_autograd=needs_graph)

    def forward(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None = None
    ) -> RefinementResult:
        """Refine every car of one or several frames.

        If `config.backward.mode` is not "none", pose and code of the result carry gradients to the masks, the images,
        the prior's tensors, the term weights, the disparity that the frames bring and the detector's standard
        deviations. They carry gradients to the input poses with "unroll". In the other modes they do so only if the
        detector has standard deviations or if results are combined with the detector's boxes (`weighs_detector`).

        Args:
            frames: F frames with dtype and device of the prior.
            detections: B cars in any order; they are converted to the dtype of the frames.
            term_weights: factors (B,) of named terms for each car, for example how far a network trusts a term. They
                multiply the weights of the configuration.

        Returns:
            Poses, shapes, statuses, costs and covariances, in the order of the detections. Cars that cannot be refined
            keep their input pose, and their status says why. They do not affect other cars.

        Raises:
            InputError: frames, detections and prior do not fit together; a term that does not exist; gradients are
                wanted of a prior that has none, or in forward mode; masks with values above 1.5.
            ConfigError: every term has weight zero.
            CompilationError: `compile: on` where no compiler works.
        """
        if torch.compiler.is_compiling():
            # A compiled model around the refiner gets one graph break here, because the iterations decide by values all
            # the time.
            return torch.compiler.disable(self._checked_refine)(frames, detections, term_weights)  # type: ignore[no-any-return, no-untyped-call]
        return self._checked_refine(frames, detections, term_weights)

    def _checked_refine(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None
    ) -> RefinementResult:
        detections = fitting(frames, detections, self.prior, (term_weights or {}).values())
        # Given standard deviations are a prior of the energy. The detector's box must not count a second time.
        sigmas = self.detector_sigmas if detections.pose_sigma is None else None
        frames, detections = self._with_rig(frames, detections)
        noise = None if sigmas is None else noise_of_boxes(sigmas, detections.T_cam_obj)
        self._warn_of(frames, detections)
        self._warn_without_gradient(frames, detections)
        differentiate = self.config.backward.mode != "none" and torch.is_grad_enabled()
        with (
            torch.set_grad_enabled(differentiate),
            full_precision(),
            compiling(self.config.compile, self.prior.origin.device),
        ):
            result, cars = self._refine(frames, detections, term_weights=term_weights, detector_noise=noise)
            result = result if noise is None else fused(result, cars)
            again = partial(self._refine, frames, term_weights=term_weights)
            return searched(self.config, frames, detections, cars, result, again)

    @property
    def weighs_detector(self) -> bool:
        """Whether results are combined with the detector's boxes.

        Standard deviations in the settings are a prior of the energy, so the box must not count a second time. Where
        points are fitted, nobody has measured what results are off by.
        """
        priors = self.config.priors
        return priors.detector_weight > 0 and not any(priors.pose_sigmas) and not self.config.fits_points

    @property
    def detector_sigmas(self) -> Tensor | None:
        """Standard deviations (7,) that weigh the detector's boxes, see `RigEstimate.detector_sigmas`, or None.

        If nothing has been learnt of the detector, they are typical values of detectors.
        """
        if not self.weighs_detector:
            return None
        learnt = None if self.rig is None else self.rig.detector_sigmas()
        return (UNKNOWN_DETECTOR if learnt is None else learnt) / math.sqrt(self.config.priors.detector_weight)

    def _warn_of(self, frames: FrameBatch, detections: Detections) -> None:
        """Warn of mistakes that the tensors of this call show, as the setting `check` asks."""
        when = self.config.check
        is_due = when == "always" or (when == "first" and not self._has_checked)
        # Under a transform of `torch.func` all that is computed is wrapped, and its numbers cannot be read.
        if not is_due or not len(detections) or not is_plain(torch.empty(1)):
            return
        # The import stands here, because only a process that asks for the check needs it, mostly once.
        from directshape_torch.check.check_scene import check_scene

        self._has_checked = True
        for finding in check_scene(frames, detections, match_images=False).findings:
            if finding.severity != "note":
                warnings.warn(str(finding), SceneWarning, stacklevel=6)

    def _warn_without_gradient(self, frames: FrameBatch, detections: Detections) -> None:
        """Warn once that a loss on the result would silently train nothing before the refiner."""
        if self._has_warned or self.config.backward.mode != "none" or not torch.is_grad_enabled():
            return
        inputs = (*frames.tensors("frames"), *detections.tensors("detections"))
        wanted = [each.name for each in inputs if each.value.requires_grad]
        if wanted:
            self._has_warned = True
            cure = "to train through the refiner set backward.mode=unroll, else call it under torch.no_grad()"
            warnings.warn(f"{', '.join(wanted)} get no gradient: {cure}", NoGradientWarning, stacklevel=6)

    def _refine(
        self,
        frames: FrameBatch,
        detections: Detections,
        chosen: Tensor | None = None,
        *,
        term_weights: Mapping[str, Tensor] | None,
        detector_noise: Tensor | None = None,
    ) -> tuple[RefinementResult, CarBatch]:
        """The result of the chosen cars (B,), by default all, and all cars with the poses that it began with."""
        if detections.track_id is not None and detections.other_T_cam_obj is not None:
            return self._refine_facing_one_way(frames, detections, term_weights, detector_noise)
        seen = self._observe(frames, detections)
        everyone = replace(self._cars(frames, detections), detector_noise=detector_noise)
        failure = refusals(everyone, seen, self.config)
        usable = Chosen.where(failure < 0 if chosen is None else (failure < 0) & chosen)
        rows, cars = usable.index, everyone.of(usable)
        seen, others, candidates = seen.of(usable), detections.other_T_cam_obj, None
        if others is not None:
            # The import stands here, because only cars with several poses need it.
            from directshape_torch.refinement.candidates import Candidates

            candidates = Candidates.of(cars, seen, others.index_select(0, rows))
        of_cars = (cars, seen) if candidates is None else (candidates.cars, candidates.seen)
        problem = problem_of_scene(
            self.config, self.prior, frames, detections, *of_cars, self.extra_terms, term_weights
        )
        unrefined = unrefined_result(self.prior, frames, detections, failure, problem.term_names)
        if not len(rows):
            return unrefined, everyone
        initial = self._input_state(cars)
        is_all = len(rows) == len(unrefined)
        beforehand = unrefined if is_all else unrefined.rows(rows)
        if candidates is None:
            found = self._minimise(problem, initial, cars, beforehand)
        else:
            found, T_cam_obj = candidates.refined(problem, initial, beforehand)
            T_cam_obj = everyone.detector_T_cam_obj.index_copy(0, rows, T_cam_obj)
            everyone = replace(everyone, detector_T_cam_obj=T_cam_obj)
        result = found if is_all else replace(unrefined.put(rows, found), term_names=found.term_names)
        return result, everyone

    def _refine_facing_one_way(
        self,
        frames: FrameBatch,
        detections: Detections,
        term_weights: Mapping[str, Tensor] | None,
        detector_noise: Tensor | None,
    ) -> tuple[RefinementResult, CarBatch]:
        """Refine cars that have tracks and several poses: each is first refined alone to choose its pose."""
        # The import stands here, because only such cars need it.
        from directshape_torch.start.driving_direction import facing_one_way

        assert detections.other_T_cam_obj is not None
        has_others = detections.other_T_cam_obj.isfinite().flatten(1).any(dim=1)
        with torch.no_grad():
            by_itself = replace(detections, track_id=None)
            alone, cars = self._refine(frames, by_itself, term_weights=term_weights, detector_noise=detector_noise)
        cars = replace(cars, track_id=detections.track_id)
        T_cam_obj, of_front = facing_one_way(cars, has_others, alone.quality.probability_heading)
        started = replace(detections, T_cam_obj=T_cam_obj, other_T_cam_obj=None)
        result, cars = self._refine(frames, started, term_weights=term_weights, detector_noise=detector_noise)
        of_front = torch.where(result.refined, of_front, torch.nan)
        return replace(result, quality=replace(result.quality, probability_heading=of_front)), cars

    @full_precision()
    def problem(
        self, frames: FrameBatch, detections: Detections, term_weights: Mapping[str, Tensor] | None = None
    ) -> tuple[CarProblem, CarState]:
        """The minimisation problem and the input state of the cars, for experiments; cars are not refused."""
        frames, detections = self._with_rig(frames, fitting(frames, detections, self.prior, ()))
        cars = self._cars(frames, detections)
        seen = self._observe(frames, detections)
        problem = problem_of_scene(
            self.config, self.prior, frames, detections, cars, seen, self.extra_terms, term_weights
        )
        return problem, self._input_state(cars)

    def _with_rig(self, frames: FrameBatch, detections: Detections) -> tuple[FrameBatch, Detections]:
        """The inputs of a call with what is known of the rig and the detector."""
        if self.rig is None:
            return frames, detections
        frames = self.rig.corrected(frames)
        informed = self.rig.informed(frames, detections)
        # Standard deviations of the settings take precedence over the rig's.
        if any(self.config.priors.pose_sigmas):
            informed = replace(informed, pose_sigma=detections.pose_sigma)
        # Points of stereo have no unknown offset.
        if self.config.fits_points:
            informed = replace(informed, offset_sigma_px=detections.offset_sigma_px)
        return frames, informed

    def _cars(self, frames: FrameBatch, detections: Detections) -> CarBatch:
        # Points of stereo have no unknown offset.
        is_known = frames.camera.disparity_field is not None or self.config.fits_points
        return CarBatch.from_scene(frames, detections, 0.0 if is_known else self.config.rig.disparity_sigma_px)

    def _input_state(self, cars: CarBatch) -> CarState:
        code = self.prior.initial_code(len(cars)).to(cars.detector_T_cam_obj)
        return CarState.of(se3.inverse(cars.detector_T_cam_obj), code, cars.num_offsets)

    def _observe(self, frames: FrameBatch, detections: Detections) -> Observation:
        """What the images show of all cars, with points of stereo where the settings fit them."""
        seen = pack_pixels(frames, detections, self.config.sampling)
        if not self.config.fits_points:
            return seen
        from directshape_torch.stereo_matching.disparity import with_disparity
        from directshape_torch.terms.car_points import car_points

        matched = with_disparity(frames, detections.frame_index)
        return replace(seen, points=car_points(matched, detections, self.config.point_cloud))

    def _minimise(
        self, problem: CarProblem, initial: CarState, cars: CarBatch, unrefined: RefinementResult
    ) -> RefinementResult:
        if cars.track_id is None:
            return Refined.of(problem, cars, initial, initial, unrefined).result(initial)
        # The import stands here, because only cars in tracks need it.
        from directshape_torch.tracks.share import brought_together

        return brought_together(problem, cars, initial, unrefined)


def _config_cure(config: object) -> str:
    """Advice how to get settings from what was given in place of them."""
    if isinstance(config, (str, PurePath)):
        return f'pass config=load_config("{config}")'
    return 'pass config=load_config("fast"), or config_from_mapping(RefinerConfig, ...) of nested keys'
