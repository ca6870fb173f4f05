"""The examples of the guide run and give what they promise."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from directshape_torch import DirectShapeRefiner, PCAShapePrior
from directshape_torch.cli.demo import demo_dataset
from directshape_torch.io.config_files import load_config
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.shape.field import field_of
from directshape_torch.status import Status
from directshape_torch.terms.term import by_autograd, linear_of

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_kitti_files_gives_a_line_for_each_car(tmp_path: Path) -> None:
    lines = example("kitti_files")["main"](tmp_path)
    assert [line.split(":")[0] for line in lines] == [f"line {number}" for number in range(1, 7)]
    assert (tmp_path / "data" / "000000.txt").is_file()


@pytest.fixture(scope="module")
def expected() -> RefinementResult:
    """The bundled frame with default settings."""
    loaded = demo_dataset().load("000000")
    return DirectShapeRefiner()(loaded.frame, loaded.detections)


def test_coco_masks_are_matched_to_their_boxes(expected: RefinementResult, tmp_path: Path) -> None:
    result = example("coco_masks")["main"](tmp_path)
    # The network of the example is less sure of its masks and knows only those of cars with boxes.
    torch.testing.assert_close(result.T_cam_obj, expected.T_cam_obj, atol=0.05, rtol=0)


def test_own_shapes_are_built_saved_and_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = example("own_shapes")["main"](tmp_path)
    assert capsys.readouterr().out.startswith("12 meshes, variance explained")
    assert isinstance(result.prior, PCAShapePrior)
    assert result.prior.provenance.num_samples == 12
    assert [status.is_refined for status in result.status].count(True) >= 5
    assert Status.singular not in result.status


def test_example_gives_what_the_batch_program_gives(capsys: pytest.CaptureFixture[str]) -> None:
    found, result = example("behind_a_detector")["main"]()
    assert capsys.readouterr().out.count("\ncar ") == len(found.score) - 1
    loaded = demo_dataset().load("000000")
    # The example knows no instances but the detector's own.
    expected = DirectShapeRefiner()(loaded.frame, replace(loaded.detections, occluders=None))
    assert result.status == expected.status
    # Projections rounded on their way through the example move a car of 13 m by up to a centimetre along its ray.
    torch.testing.assert_close(result.T_cam_obj, expected.T_cam_obj, atol=2e-2, rtol=0)


def test_an_upright_prior_pulls_cars_upright(expected: RefinementResult) -> None:
    of = example("upright_prior")
    result = of["main"]()
    column = result.term_names.index("upright")

    def lean(T_cam_obj: torch.Tensor) -> torch.Tensor:
        return T_cam_obj[:, 1, [0, 2]].norm(dim=1)

    assert float(lean(result.T_cam_obj).norm()) < 0.9 * float(lean(expected.T_cam_obj).norm())
    # Half its weight times the squared sines of what is left.
    cost, expected = result.cost_after[:, column].float(), 200 * lean(result.T_cam_obj).square()
    torch.testing.assert_close(cost[result.refined], expected[result.refined], atol=1e-4, rtol=1e-3)


def test_the_jacobian_of_the_upright_prior_is_right() -> None:
    of = example("upright_prior")
    exact = load_config(None, ["rig.disparity_sigma_px=0"])
    problem, state = DirectShapeRefiner(None, exact, [of["upright_prior"]]).problem(*_demo(of))
    state = state.unknowns.retract(state, 0.2 * torch.randn(len(state.code), state.unknowns.size))
    (term,) = problem.extra_terms
    at = linear_of(term, problem.prior, field_of(problem.prior.bind(state.code)), state, ())
    ((residual, jacobian),) = by_autograd([term], problem.prior, state, [()])
    torch.testing.assert_close(at.residual, residual)
    torch.testing.assert_close(at.J_residual_inner[..., None] * at.J_inner_state[:, :, None], jacobian.to(at.residual))


def test_lidar_points_bring_cars_to_where_they_are() -> None:
    without, result, truth = example("lidar_points")["main"]()
    assert "lidar" in result.term_names
    assert "lidar" not in without.term_names
    error, error_without = ((r.T_cam_obj - truth)[:, :3, 3].norm(dim=1) for r in (result, without))
    assert float(error.max()) < 0.12
    assert float(error.mean()) < 0.75 * float(error_without.mean())


def _demo(of: dict[str, Any]) -> tuple[Any, Any]:
    root = of["ROOT"]
    loaded = of["open_dataset"]("kitti", root, root / "detections" / "noisy_stereo", root / "training" / "masks")
    frame = loaded.load("000000")
    return frame.frame, frame.detections
