"""Targets of the mutation script: functions of residuals and of their sums."""

from __future__ import annotations

from jacobian_mutants.target import Target

TARGETS: dict[str, Target] = {
    "state_chain": Target(
        "directshape_torch/residuals/state_chain.py", ("sdf_state_jacobian",), ("tests/residuals/test_state_chain.py",)
    ),
    "point_cloud": Target(
        "directshape_torch/residuals/point_cloud.py",
        ("points_in_object", "point_cloud_distance", "point_cloud_residual"),
        ("tests/residuals/test_point_cloud.py",),
    ),
    "silhouette": Target(
        "directshape_torch/residuals/silhouette.py",
        (
            "project_closest_approach",
            "project_product",
            "log_one_minus_exp",
            "clamp_foreground",
            "silhouette_residual",
            "residual_derivative_closest_approach",
            "_sigmoids",
            "residual_derivative_product",
        ),
        ("tests/residuals/test_silhouette.py", "tests/residuals/test_silhouette_dilation.py"),
    ),
    "photometric": Target(
        "directshape_torch/residuals/photometric.py",
        ("surface_slope", "depth_state_jacobian", "photometric_residual"),
        ("tests/residuals/test_photometric.py",),
    ),
    "photometric_patch": Target(
        "directshape_torch/residuals/photometric_patch.py",
        ("patch_residual", "patch_derivative", "_mean", "_centred", "_contrast"),
        ("tests/residuals/test_photometric_patch.py",),
    ),
    "priors": Target(
        "directshape_torch/residuals/priors.py",
        (
            "shape_prior",
            "height_prior",
            "tilt_prior_normal",
            "tilt_prior_cosine",
            "_by_rotation",
            "dimensions_prior",
            "pose_prior",
            "viewing_axes",
        ),
        ("tests/residuals/test_priors.py",),
    ),
    "robust": Target(
        "directshape_torch/residuals/robust.py",
        ("quadratic", "huber", "huber_cost", "truncated_huber", "identity"),
        ("tests/residuals/test_robust.py",),
    ),
    "normal_equations": Target(
        "directshape_torch/solver/normal_equations.py",
        (
            "RowBlocks.of_sorted",
            "RowBlocks.num_blocks",
            "RowBlocks.block_rows",
            "RowBlocks._first_block",
            "Segments.object_blocks",
            "Segments._blocks",
            "Segments._sum_over_blocks",
            "Segments.sum",
            "Segments.accumulate",
            "_sum_of_runs",
        ),
        ("tests/solver/test_normal_equations.py",),
    ),
}
