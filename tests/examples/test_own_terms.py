"""The examples of docs/extra_terms.md run, and a term of one's own counts like those of the method."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import torch

from directshape_torch import DirectShapeRefiner
from directshape_torch.shape.field import field_of
from directshape_torch.terms.cars import retract
from directshape_torch.terms.term import by_autograd

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_an_upright_prior_pulls_cars_upright() -> None:
    of = example("upright_prior")
    result = of["main"]()
    column = result.term_names.index("upright")
    without = DirectShapeRefiner()(*_demo(of))

    def lean(T_cam_obj: torch.Tensor) -> torch.Tensor:
        return T_cam_obj[:, 1, [0, 2]].norm(dim=1)

    assert float(lean(result.T_cam_obj).norm()) < 0.9 * float(lean(without.T_cam_obj).norm())
    # Half its weight times the squared sines of what is left.
    torch.testing.assert_close(
        result.cost_after[:, column].float(), 200 * lean(result.T_cam_obj).square(), atol=1e-4, rtol=1e-3
    )


def test_the_jacobian_of_the_upright_prior_is_right() -> None:
    of = example("upright_prior")
    problem, state = DirectShapeRefiner(extra_terms=[of["upright_prior"]]).problem(*_demo(of))
    state = retract(state, 0.2 * torch.randn(len(state.code), 6 + state.code.shape[1]))
    term = problem.terms[problem.term_names.index("upright") - len(problem.term_names)]
    at = term.linear(field_of(problem.prior.bind(state.code)), state, ())
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
    loaded = of["KittiStereoDataset"](root, root / "detections" / "noisy_stereo", root / "training" / "masks")
    frame = loaded.load("000000")
    return frame.frame, frame.detections
