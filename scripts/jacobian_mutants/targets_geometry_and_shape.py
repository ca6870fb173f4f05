"""Targets of the mutation script: functions of geometry, images and shapes."""

from __future__ import annotations

from jacobian_mutants.target import Target

_SE3_TESTS = tuple(
    f"tests/geometry/test_se3_{name}.py"
    for name in ("generators", "group", "exp_log", "series", "references", "gradients")
)

TARGETS: dict[str, Target] = {
    "se3_exp": Target(
        "directshape_torch/geometry/se3.py",
        ("generators", "_higher_exp_coefficients", "exp", "from_rotation_translation"),
        _SE3_TESTS,
    ),
    "se3_group": Target(
        "directshape_torch/geometry/se3.py", ("inverse", "transform", "from_kornia", "to_kornia"), _SE3_TESTS
    ),
    "retract": Target("directshape_torch/energy/car_state.py", ("retract",), ("tests/energy/test_car_state.py",)),
    "pinhole": Target(
        "directshape_torch/geometry/pinhole.py", ("rays_from_pixels", "project"), ("tests/geometry/test_pinhole.py",)
    ),
    "stereo_warp": Target(
        "directshape_torch/geometry/stereo.py",
        ("warp_to_right", "_shifted", "right_rays"),
        ("tests/geometry/test_stereo.py",),
    ),
    "bilinear": Target(
        "directshape_torch/image/interpolate.py",
        ("bilinear_with_gradient", "_cell"),
        ("tests/image/test_interpolate.py",),
    ),
    "sdf_grid": Target(
        "directshape_torch/shape/sdf_grid.py",
        (
            "GridShape.__init__",
            "GridShape.value",
            "GridShape.value_and_derivatives",
            "GridShape.gradient",
            "GridMemory.values",
        ),
        ("tests/shape/test_sdf_grid.py", "tests/shape/test_pca_prior.py"),
    ),
    "grid_lookup": Target(
        "directshape_torch/shape/grid_lookup.py",
        (
            "value_at",
            "derivatives_at",
            "gradient_at",
            "_value_and_gradient",
            "_corner_values",
            "_ends",
            "_difference",
            "_interpolated_basis",
            "_summed_basis",
            "_along",
        ),
        ("tests/shape/test_grid_lookup.py", "tests/shape/test_sdf_grid.py", "tests/shape/test_many_lookups.py"),
    ),
    "grid_cells": Target(
        "directshape_torch/shape/grid_cells.py",
        ("GridField.num_nodes", "GridField.corners", "Cells.distance", "cells_at", "_safe_norm"),
        (
            "tests/shape/test_grid_lookup.py",
            "tests/shape/test_sdf_grid.py",
            "tests/shape/test_many_lookups.py",
            "tests/shape/test_traced_lookup.py",
        ),
    ),
    "traced_lookup": Target(
        "directshape_torch/shape/traced_lookup.py",
        ("traced_value_at", "traced_derivatives_at", "_entries", "_interpolated", "_along", "_moved", "_differences"),
        ("tests/shape/test_traced_lookup.py",),
    ),
    "short_axes": Target(
        "directshape_torch/geometry/short_axes.py",
        ("length", "all_along", "cross"),
        ("tests/geometry/test_short_axes.py",),
    ),
    "ray_depth": Target(
        "directshape_torch/shape/raycast.py",
        ("ObjectRays.at", "attached_depth", "_newton_step"),
        ("tests/shape/test_raycast.py", "tests/residuals/test_photometric.py"),
    ),
    "compiled_probe": Target(
        "directshape_torch/shape/compiled_probe.py",
        ("compiled_entry", "probe_grids", "_bracket"),
        ("tests/shape/test_compiled_march.py",),
    ),
    "bracket": Target(
        "directshape_torch/shape/bracket.py",
        ("Bracket.between", "Bracket.probed", "_line_zero"),
        ("tests/shape/test_bracket.py",),
    ),
    "neural_prior": Target(
        "directshape_torch/shape/neural_prior.py",
        (
            "CodedLinear.shift",
            "NeuralShapePrior.dimensions_and_derivative",
            "NeuralShape._value",
            "NeuralShape._value_and_derivatives",
            "NeuralShape._split",
            "NeuralShape._linear",
            "_mirrored",
            "_mirrored_slope",
            "_safe_norm",
        ),
        ("tests/shape/test_neural_prior.py", "tests/shape/test_prior_protocol.py"),
    ),
    "kernel_pca_prior": Target(
        "directshape_torch/shape/kernel_pca_prior.py",
        (
            "KernelPCAShapePrior.coefficients",
            "KernelPCAShapePrior.dimensions_and_derivative",
            "CurvedGridShape.value_and_derivatives",
        ),
        ("tests/shape/test_kernel_pca_prior.py", "tests/shape/test_prior_protocol.py"),
    ),
}
