"""These tests check gradients in use: modes, warnings, weights of terms, memory, compiled models."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.problems import DEFAULT
from helpers.street_inputs import SETTLED, UNSETTLED, StreetInputs, summary, unsettled, with_mode
from helpers.synthetic_scene import masked
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.errors import InputError, NoGradientWarning
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.solver.differentiate import NotStationaryWarning

MODES = ("unroll", "implicit", "implicit_gauss_newton")


@pytest.fixture(scope="module")
def inputs() -> StreetInputs:
    return StreetInputs()


@pytest.mark.parametrize("mode", MODES)
def test_the_result_is_that_without_gradients_to_the_bit(inputs: StreetInputs, mode: str) -> None:
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    plain, attached = inputs.refine(UNSETTLED), inputs.refine(unsettled(mode), "masks", by)
    assert torch.equal(plain.T_cam_obj, attached.T_cam_obj)
    assert torch.equal(plain.code, attached.code)
    assert plain.status == attached.status
    assert attached.T_cam_obj.requires_grad
    assert not attached.covariance.requires_grad


def test_no_graph_without_a_mode_and_under_no_grad(inputs: StreetInputs) -> None:
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    with pytest.warns(NoGradientWarning, match=r"detections.mask_left.* get no gradient: .* backward.mode=unroll"):
        assert not inputs.refine(UNSETTLED, "masks", by).T_cam_obj.requires_grad
    with torch.no_grad():
        assert not inputs.refine(unsettled("implicit"), "masks", by).T_cam_obj.requires_grad
    with torch.inference_mode():
        assert not inputs.refine(unsettled("unroll")).T_cam_obj.requires_grad


@pytest.mark.parametrize("mode", ["none", "unroll", "implicit"])
def test_forward_mode_is_refused(inputs: StreetInputs, mode: str) -> None:
    """Tangents pass through what gradients are held back from: they would come out wrong, without a word."""
    config = UNSETTLED if mode == "none" else unsettled(mode)
    frames, detections = inputs.scene.frames, replace(inputs.detections, mask_left=inputs.mask)
    refiner = DirectShapeRefiner(inputs.prior, config)

    def refined(images: Tensor) -> Tensor:
        return refiner(replace(frames, images_left=images), detections).T_cam_obj

    with pytest.raises(InputError, match=r"without tangents of forward-mode differentiation.*reverse mode"):
        torch.func.jvp(refined, (frames.images_left,), (torch.ones_like(frames.images_left),))


def test_a_constant_of_somebody_elses_derivative_is_refined(inputs: StreetInputs) -> None:
    refiner = DirectShapeRefiner(inputs.prior, UNSETTLED)
    frames, detections = inputs.scene.frames, replace(inputs.detections, mask_left=inputs.mask)
    one = torch.ones(1, dtype=torch.float64)
    found, tangent = torch.func.jvp(lambda x: x * refiner(frames, detections).T_cam_obj, (one,), (one,))
    torch.testing.assert_close(found, refiner(frames, detections).T_cam_obj, rtol=0, atol=1e-6)
    assert torch.equal(tangent, found)


def test_an_unconverged_car_is_named_by_the_callers_numbers_and_has_a_zero_gradient(inputs: StreetInputs) -> None:
    config = with_mode("implicit", replace(SETTLED, stages=(StageConfig(1.0, 0, 1),)), max_remaining_step=1e-6)
    T_cam_obj = inputs.detections.T_cam_obj.clone()
    T_cam_obj[0, 2, 3] = -5.0
    mask = inputs.mask.clone().requires_grad_()
    detections = replace(inputs.detections, T_cam_obj=T_cam_obj, mask_left=mask)
    with pytest.warns(NotStationaryWarning, match="problems 1:"):
        result = DirectShapeRefiner(inputs.prior, config)(inputs.scene.frames, detections)
    (gradient,) = torch.autograd.grad(summary(result), mask)
    assert not gradient.any()


def test_weights_of_one_change_nothing_and_others_do(inputs: StreetInputs) -> None:
    plain, same = inputs.refine(DEFAULT), inputs.refine(DEFAULT, "weights", 0.0)
    torch.testing.assert_close(same.T_cam_obj, plain.T_cam_obj, rtol=0, atol=1e-12)
    heavier = inputs.refine(DEFAULT, "weights", 3.0)
    assert (heavier.T_cam_obj - plain.T_cam_obj).abs().max() > 1e-4
    silhouette = plain.term_names.index("silhouette_left")
    ratio = heavier.cost_before[:, silhouette] / plain.cost_before[:, silhouette]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 4.0), rtol=0.2, atol=0)


def test_a_misspelt_term_is_an_error_that_lists_the_names(inputs: StreetInputs) -> None:
    refiner = DirectShapeRefiner(inputs.prior, DEFAULT)
    weights = {"silhouete_left": torch.ones(len(inputs.detections), dtype=torch.float64)}
    hidden = masked(inputs.detections, inputs.detections.has_mask_left & False)
    for detections in (inputs.detections, hidden):  # a slip is a slip in frames without a usable car as well
        with pytest.raises(InputError, match=r"silhouette_left, silhouette_right.*'silhouete_left'"):
            refiner(inputs.scene.frames, detections, weights)
    with pytest.raises(InputError, match=r"term_weights\['height'\]"):
        refiner(inputs.scene.frames, inputs.detections, {"height": torch.ones(7, dtype=torch.float64)})


def test_wrong_weights_are_errors_and_one_that_is_no_number_is_a_matter_of_its_car(inputs: StreetInputs) -> None:
    refiner = DirectShapeRefiner(inputs.prior, with_mode("unroll", DEFAULT))
    arguments = (inputs.scene.frames, inputs.detections)
    with pytest.raises(InputError, match=r"term_weights\['height'\]: expected factors .*, got -0.5 in row 1"):
        refiner(*arguments, {"height": torch.tensor([1.0, -0.5], dtype=torch.float64)})
    with pytest.raises(InputError, match=r"term_weights\['height'\]: expected a tensor of shape \(2,\), got float"):
        refiner(*arguments, {"height": 2.0})
    weight = torch.tensor([torch.nan, 1.0], dtype=torch.float64, requires_grad=True)
    result = refiner(*arguments, {"height": weight})
    assert result.status[0].name == "non_finite"
    assert result.refined.tolist() == [False, True]
    torch.testing.assert_close(result.T_cam_obj[1], refiner(*arguments).T_cam_obj[1], rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(summary(result), weight)
    assert gradient.isfinite().all()
    assert gradient[1] != 0


def test_memory_of_implicit_does_not_grow_with_the_iterations(inputs: StreetInputs) -> None:
    """Bytes that are saved for the backward pass, each storage once."""

    def saved_bytes(mode: str, iterations: int) -> int:
        stage = (StageConfig(1.0, 0, iterations),)
        config = with_mode(mode, replace(SETTLED, stages=stage), max_remaining_step=1e9)
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


def test_a_compiled_model_around_it_has_one_break_in_its_graph(inputs: StreetInputs) -> None:
    import torch._dynamo

    class Model(torch.nn.Module):
        def __init__(self, refine: Callable[..., RefinementResult]) -> None:
            super().__init__()
            self.log_weight = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))
            self.refine = refine

        def forward(self, frames: FrameBatch, detections: Detections) -> Tensor:
            weights = {"silhouette_right": torch.exp(self.log_weight) * torch.ones_like(detections.score)}
            return self.refine(frames, detections, weights).T_cam_obj * 2

    model = Model(DirectShapeRefiner(inputs.prior, with_mode("implicit", DEFAULT, max_remaining_step=1e9)))
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
