"""Gradients through the refiner: each differentiable input against differences, the modes against each other."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed, joined_detections, joined_frames
from torch import Tensor

from directshape_torch.config import BackwardConfig, RefinerConfig, StageConfig
from directshape_torch.errors import InputError
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.solver.differentiate import NotStationaryWarning

# Undamped steps settle where the gradient vanishes; accepting by the cost ends within the rounding of the cost.
SETTLED = replace(
    DEFAULT,
    stages=(StageConfig(2.0, 1, 10), StageConfig(1.0, 0, 40)),
    # Sets that a stage fixes at its start, the gain among them, are constants for gradients but not for differences.
    photometric=replace(DEFAULT.photometric, gain=False),
    solver=replace(DEFAULT.solver, cost_tolerance=0.0, step_tolerance=1e-9, accept_every_step=True, initial_damping=0),
)
MODES = ("unroll", "implicit", "implicit_gauss_newton")


class Inputs:
    """Everything that can be differentiated by, moved along one seeded direction each by a scalar."""

    def __init__(self) -> None:
        self.prior, self.scene = cached_street()
        self.detections = disturbed(self.scene.detections)
        generator = torch.Generator().manual_seed(5)

        def noise(like: Tensor) -> Tensor:
            return torch.randn(like.shape, generator=generator, dtype=like.dtype)

        # Clamped mask probabilities have no gradient.
        self.mask = self.detections.mask_left.clamp(0.2, 0.8)
        self.mask_direction = 0.1 * noise(self.mask)
        self.image_direction = 0.02 * noise(self.scene.frames.images_right)
        self.basis_direction = 0.05 * self.prior.basis.flip(-1)
        self.mean_direction = 0.02 * torch.ones_like(self.prior.mean)

    def refine(self, config: RefinerConfig, what: str = "nothing", by: Tensor | float = 0.0) -> RefinementResult:
        frames, detections, weights = self.scene.frames, replace(self.detections, mask_left=self.mask), None
        prior = self.prior
        if what == "masks":
            detections = replace(detections, mask_left=self.mask + by * self.mask_direction)
        elif what == "images":
            frames = replace(frames, images_right=frames.images_right + by * self.image_direction)
        elif what == "weights":
            weights = {"silhouette_left": torch.ones(len(detections), dtype=torch.float64) * (1 + by)}
        elif what == "basis":
            prior = _prior_with(basis=prior.basis + by * self.basis_direction)
        elif what == "sigma":
            sigma = 1 + by * torch.ones(prior.num_codes, dtype=torch.float64)
            prior = _prior_with(basis=prior.basis * sigma, dimensions_basis_hwl=prior.dimensions_basis_hwl * sigma)
        elif what == "mean":
            prior = _prior_with(mean=prior.mean + by * self.mean_direction)
        elif what == "pose":
            shift = torch.zeros_like(detections.T_cam_obj)
            shift[:, 0, 3] = 1.0
            detections = replace(detections, T_cam_obj=detections.T_cam_obj + by * shift)
        return DirectShapeRefiner(prior, config)(frames, detections, weights)


def _prior_with(**tensors: Tensor) -> PCAShapePrior:
    copy = ellipsoid_prior()
    for name, tensor in tensors.items():
        setattr(copy, name, tensor)
    return copy


def _summary(result: RefinementResult) -> Tensor:
    """One number that depends on position, heading and shape of every car."""
    weight = torch.arange(1, result.code.shape[1] + 1, dtype=torch.float64)
    return result.T_cam_obj[:, :3, 3].sum() + result.T_cam_obj[:, 0, 2].sum() + (result.code * weight).sum()


def _gradient(inputs: Inputs, config: RefinerConfig, what: str) -> float:
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(_summary(inputs.refine(config, what, by)), by)
    return float(gradient)


def _mode(mode: str, config: RefinerConfig = SETTLED, **settings: float) -> RefinerConfig:
    return replace(config, backward=BackwardConfig(mode=mode, **{"unroll_iterations": 200, **settings}))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def inputs() -> Inputs:
    return Inputs()


@pytest.mark.parametrize("what", ["masks", "images", "weights", "basis", "mean", "sigma"])
def test_modes_agree_with_each_other_and_with_differences(inputs: Inputs, what: str) -> None:
    implicit = _gradient(inputs, _mode("implicit"), what)
    unrolled = _gradient(inputs, _mode("unroll"), what)
    step = 1e-4
    ends = [float(_summary(inputs.refine(SETTLED, what, sign * step))) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * step)
    assert abs(implicit) > 1e-4
    # The best state by the cost may stand some steps before the point where the gradient vanishes.
    assert abs(unrolled - implicit) < 1e-3 + 0.02 * abs(implicit)
    # A difference of refinements crosses borders of pixels and of grid cells, where the gradient jumps.
    assert abs(numeric - unrolled) < 1e-3 + 0.02 * abs(unrolled)


def test_the_gauss_newton_matrix_is_near_but_not_equal(inputs: Inputs) -> None:
    exact, approximate = (_gradient(inputs, _mode(mode), "images") for mode in ("implicit", "implicit_gauss_newton"))
    assert 1e-4 < abs(approximate - exact) / abs(exact) < 0.5


def test_the_input_pose_counts_when_the_window_reaches_back_to_it(inputs: Inputs) -> None:
    few = replace(SETTLED, stages=(StageConfig(1.0, 0, 2),))
    whole = _gradient(inputs, _mode("unroll", few), "pose")
    last_step_only = _gradient(inputs, _mode("unroll", few, unroll_iterations=1), "pose")
    step = 1e-6
    ends = [float(_summary(inputs.refine(few, "pose", sign * step))) for sign in (1, -1)]
    # zeta follows the input depth; here the car moves sideways and it stays.
    assert abs(whole - (ends[0] - ends[1]) / (2 * step)) < 1e-5 * abs(whole)
    assert abs(whole) > 1e-3
    assert last_step_only == 0


@pytest.mark.parametrize("mode", MODES)
def test_the_result_is_that_without_gradients_to_the_bit(inputs: Inputs, mode: str) -> None:
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    plain, attached = inputs.refine(SETTLED), inputs.refine(_mode(mode), "masks", by)
    assert torch.equal(plain.T_cam_obj, attached.T_cam_obj)
    assert torch.equal(plain.code, attached.code)
    assert plain.status == attached.status
    assert attached.T_cam_obj.requires_grad
    assert not attached.covariance.requires_grad


def test_no_graph_without_a_mode_and_under_no_grad(inputs: Inputs) -> None:
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    assert not inputs.refine(SETTLED, "masks", by).T_cam_obj.requires_grad
    with torch.no_grad():
        assert not inputs.refine(_mode("implicit"), "masks", by).T_cam_obj.requires_grad
    with torch.inference_mode():
        assert not inputs.refine(_mode("unroll")).T_cam_obj.requires_grad


def test_boxes_carry_the_gradient(inputs: Inputs) -> None:
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    boxes = inputs.refine(_mode("implicit"), "mean", by).boxes()
    (gradient,) = torch.autograd.grad(boxes.dimensions_hwl.sum(), by)
    step = 1e-4
    ends = [float(inputs.refine(SETTLED, "mean", sign * step).boxes().dimensions_hwl.sum()) for sign in (1, -1)]
    assert abs(float(gradient) - (ends[0] - ends[1]) / (2 * step)) < 0.05 * abs(float(gradient)) + 1e-3


@pytest.mark.parametrize("mode", ["implicit", "unroll"])
@pytest.mark.parametrize("depth", [-5.0, 0.0, torch.nan])
def test_cars_that_fail_pass_their_input_through_and_leave_the_others_alone(
    inputs: Inputs, depth: float, mode: str
) -> None:
    detections = replace(inputs.detections, mask_left=inputs.mask)
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[1, 2, 3] = depth
    T_cam_obj.requires_grad_()
    mask = inputs.mask.clone().requires_grad_()
    broken = replace(detections, T_cam_obj=T_cam_obj, mask_left=mask)
    result = DirectShapeRefiner(inputs.prior, _mode(mode))(inputs.scene.frames, broken)
    assert not result.refined[1]
    by_pose, by_mask = torch.autograd.grad(result.T_cam_obj[:, :3, 3].sum(), [T_cam_obj, mask])
    only_the_position = torch.zeros(4, 4, dtype=torch.float64)
    only_the_position[:3, 3] = 1
    assert torch.equal(by_pose[1], only_the_position)
    assert by_pose.isfinite().all()
    assert by_mask[0].abs().max() > 0
    assert by_mask.isfinite().all()


@pytest.mark.parametrize("mode", MODES)
def test_a_nan_image_gives_no_nan_gradient(inputs: Inputs, mode: str) -> None:
    frames, detections = _two_frames(inputs)
    images = frames.images_left.clone()
    images[1] = torch.nan
    mask = detections.mask_left.clone().requires_grad_()
    refiner = DirectShapeRefiner(inputs.prior, _mode(mode))
    result = refiner(replace(frames, images_left=images), replace(detections, mask_left=mask))
    assert not result.refined[detections.frame_index == 1].any()
    (gradient,) = torch.autograd.grad(_summary(result), mask)
    assert gradient.isfinite().all()
    assert gradient[detections.frame_index == 0].abs().max() > 0


def _two_frames(inputs: Inputs) -> tuple[FrameBatch, Detections]:
    d = replace(inputs.detections, mask_left=inputs.mask)
    size_hw = tuple(inputs.scene.frames.images_left.shape[2:])
    return joined_frames([inputs.scene.frames] * 2), joined_detections([d, d], size_hw)


def test_an_unconverged_car_is_named_and_has_a_zero_gradient(inputs: Inputs) -> None:
    config = _mode("implicit", replace(SETTLED, stages=(StageConfig(1.0, 0, 1),)), max_remaining_step=1e-6)
    with pytest.warns(NotStationaryWarning, match="problems 0, 1"):
        assert _gradient(inputs, config, "masks") == 0


def test_the_warning_names_cars_by_the_callers_numbers(inputs: Inputs) -> None:
    config = _mode("implicit", replace(SETTLED, stages=(StageConfig(1.0, 0, 1),)), max_remaining_step=1e-6)
    T_cam_obj = inputs.detections.T_cam_obj.clone()
    T_cam_obj[0, 2, 3] = -5.0
    detections = replace(inputs.detections, T_cam_obj=T_cam_obj, mask_left=inputs.mask.clone().requires_grad_())
    with pytest.warns(NotStationaryWarning, match="problems 1:"):
        DirectShapeRefiner(inputs.prior, config)(inputs.scene.frames, detections)


def test_the_input_depth_counts_by_the_softness_of_the_contour_even_where_the_start_does_not(inputs: Inputs) -> None:
    def summary(config: RefinerConfig, depth: Tensor | float) -> Tensor:
        shift = torch.zeros_like(inputs.detections.T_cam_obj)
        shift[:, 2, 3] = 1.0
        moved = replace(inputs.detections, T_cam_obj=inputs.detections.T_cam_obj + depth * shift, mask_left=inputs.mask)
        return _summary(DirectShapeRefiner(inputs.prior, config)(inputs.scene.frames, moved))

    depth = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(summary(_mode("implicit"), depth), depth)
    step = 1e-4
    numeric = float(summary(SETTLED, step) - summary(SETTLED, -step)) / (2 * step)
    assert abs(float(gradient) - numeric) < 0.05 * abs(numeric)


def test_the_gain_follows_the_images(inputs: Inputs) -> None:
    matched = replace(SETTLED, photometric=replace(SETTLED.photometric, gain=True))
    implicit, unrolled = (_gradient(inputs, _mode(mode, matched), "images") for mode in ("implicit", "unroll"))
    step = 1e-4
    ends = [float(_summary(inputs.refine(matched, "images", sign * step))) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * step)
    # Left out: the state at which the stage begins follows the images. A constant gain would be 20 percent off.
    assert abs(implicit - numeric) < 0.03 * abs(numeric)
    assert abs(unrolled - numeric) < 0.03 * abs(numeric)


def test_weights_of_one_change_nothing_and_others_do(inputs: Inputs) -> None:
    plain, same = inputs.refine(DEFAULT), inputs.refine(DEFAULT, "weights", 0.0)
    torch.testing.assert_close(same.T_cam_obj, plain.T_cam_obj, rtol=0, atol=1e-12)
    heavier = inputs.refine(DEFAULT, "weights", 3.0)
    assert (heavier.T_cam_obj - plain.T_cam_obj).abs().max() > 1e-4
    silhouette = plain.term_names.index("silhouette_left")
    ratio = heavier.cost_before[:, silhouette] / plain.cost_before[:, silhouette]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 4.0), rtol=0.2, atol=0)


def test_a_misspelt_term_is_an_error_that_lists_the_names(inputs: Inputs) -> None:
    refiner = DirectShapeRefiner(inputs.prior, DEFAULT)
    weights = {"silhouete_left": torch.ones(len(inputs.detections), dtype=torch.float64)}
    with pytest.raises(InputError, match=r"silhouette_left, silhouette_right.*'silhouete_left'"):
        refiner(inputs.scene.frames, inputs.detections, weights)
    with pytest.raises(InputError, match=r"term_weights\['height'\]"):
        refiner(inputs.scene.frames, inputs.detections, {"height": torch.ones(7, dtype=torch.float64)})


def test_wrong_weights_are_errors_and_one_that_is_no_number_is_a_matter_of_its_car(inputs: Inputs) -> None:
    refiner = DirectShapeRefiner(inputs.prior, _mode("unroll", DEFAULT))
    arguments = (inputs.scene.frames, inputs.detections)
    with pytest.raises(InputError, match=r"term_weights\['height'\]: expected factors .*, got -0.5 for car 1"):
        refiner(*arguments, {"height": torch.tensor([1.0, -0.5], dtype=torch.float64)})
    with pytest.raises(InputError, match=r"term_weights\['height'\]: expected a tensor of shape \(2,\), got float"):
        refiner(*arguments, {"height": 2.0})
    weight = torch.tensor([torch.nan, 1.0], dtype=torch.float64, requires_grad=True)
    result = refiner(*arguments, {"height": weight})
    assert result.status[0].name == "non_finite"
    assert result.refined.tolist() == [False, True]
    torch.testing.assert_close(result.T_cam_obj[1], refiner(*arguments).T_cam_obj[1], rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(_summary(result), weight)
    assert gradient.isfinite().all()
    assert gradient[1] != 0


def test_memory_of_implicit_does_not_grow_with_the_iterations(inputs: Inputs) -> None:
    """Bytes that are saved for the backward pass, each storage once."""

    def saved_bytes(mode: str, iterations: int) -> int:
        stage = (StageConfig(1.0, 0, iterations),)
        config = _mode(mode, replace(SETTLED, stages=stage), max_remaining_step=1e9)
        by = torch.zeros((), dtype=torch.float64, requires_grad=True)
        storages: dict[int, torch.UntypedStorage] = {}

        def keep(tensor: Tensor) -> Tensor:
            storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            inputs.refine(config, "masks", by)
        return sum(storage.nbytes() for storage in storages.values())

    few, many = saved_bytes("implicit", 4), saved_bytes("implicit", 16)
    assert few > 1e6
    # The sets of pixels are those of the stage's start in both, the samples on the rays are not.
    assert abs(many - few) < 0.05 * few
    assert saved_bytes("unroll", 16) > 2 * saved_bytes("unroll", 4)


def test_under_autocast_it_computes_in_the_precision_of_its_inputs() -> None:
    _, scene = cached_street()
    low = ellipsoid_prior(torch.float32)
    frames = scene.frames.to(dtype=torch.float32)
    detections = disturbed(scene.detections).to(dtype=torch.float32)
    refiner = DirectShapeRefiner(low, DEFAULT)
    plain = refiner(frames, detections)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = refiner(frames, detections)
    assert torch.equal(plain.T_cam_obj, cast.T_cam_obj)


def test_a_compiled_model_around_it_has_one_break_in_its_graph(inputs: Inputs) -> None:
    import torch._dynamo

    class Model(torch.nn.Module):
        def __init__(self, refine: Callable[..., RefinementResult]) -> None:
            super().__init__()
            self.log_weight = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))
            self.refine = refine

        def forward(self, frames: FrameBatch, detections: Detections) -> Tensor:
            weights = {"silhouette_right": torch.exp(self.log_weight) * torch.ones_like(detections.score)}
            return self.refine(frames, detections, weights).T_cam_obj * 2

    model = Model(DirectShapeRefiner(inputs.prior, _mode("implicit", DEFAULT, max_remaining_step=1e9)))
    arguments = (inputs.scene.frames, inputs.detections)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reasons = torch._dynamo.explain(model)(*arguments).break_reasons
        torch._dynamo.reset()
        output = torch.compile(model, backend="eager")(*arguments)
    torch._dynamo.reset()
    torch.testing.assert_close(output, model(*arguments), rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(output[:, :3, 3].sum(), model.log_weight)
    assert gradient.isfinite()
    assert gradient != 0
    assert len(reasons) == 1
