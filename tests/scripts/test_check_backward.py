"""Gradients of whole refinements of the bundled frame reach all numbers of a box."""

from __future__ import annotations

from dataclasses import replace

import check_backward as script
import torch

from directshape_torch import load_config


def test_all_seven_numbers_of_a_box_have_the_gradient_of_the_refinement() -> None:
    """As shipped but for the number of pixels: mode `unroll` and nothing else."""
    config = load_config("default", ["backward.mode=unroll", *script.THINNED[1:]])
    scene = script.Scene.of_demo(1)
    scene = replace(scene, detections=replace(scene.detections, pose_sigma=None))
    found = script.gradients(scene, config, script.BOX)
    numeric = script.differences(scene, config, 2.5e-7, script.BOX)
    assert found.abs().min() > 1e-3
    assert float(((found - numeric).abs() / numeric.abs()).median()) < 1e-4
    assert float(((found - numeric).abs() / numeric.abs()).max()) < 0.05


def test_a_row_tells_jumps_from_errors_and_cars_without_a_gradient() -> None:
    numeric = torch.tensor([[1.0], [2.0], [3.0]]).expand(3, 2)
    said = {"unroll": numeric * 1.01, "implicit": numeric * torch.tensor([1.01, 0.0]), "implicit_gauss_newton": None}
    row = script.Row("default", numeric, numeric * torch.tensor([1.0, 2.0]), said)
    assert row.smooth.tolist() == [[True, False]] * 3
    table = script.as_markdown([row])
    assert "| default | 3 | 3 | 1e-02 / 1e-02 | 1e-02 / 1e-02, 1 without | refused |" in table
