"""Which functions hold hand-derived derivatives, and which tests must catch a mistake in them."""

from __future__ import annotations

from dataclasses import dataclass

_SE3_TESTS = tuple(
    f"tests/geometry/test_se3_{name}.py"
    for name in ("generators", "group", "adjoint", "exp_log", "series", "references", "gradients")
)
_ROWS = (
    "tests/energy/test_autograd_jacobian.py::test_linearise_is_accumulate_of_residuals_and_jacobian",
    "tests/energy/test_autograd_jacobian.py::test_rows_of_every_term_agree",
)
_COST = "tests/energy/test_gradient_of_the_cost.py"
_TRACKED = "tests/energy/test_tracked_energy.py"
_FOLLOWING = tuple(
    f"tests/energy/test_following_rays.py::{name}"
    for name in (
        "test_a_refused_step_leaves_no_trace",
        "test_each_car_follows_for_itself",
        "test_cars_that_leave_change_nothing_of_the_others",
        "test_a_car_without_any_pixel_has_its_priors_alone",
    )
)


@dataclass(frozen=True)
class Target:
    """Functions of one file (`Class.method` for methods) and the tests named for them, the quickest first."""

    path: str
    functions: tuple[str, ...]
    tests: tuple[str, ...]


TARGETS: dict[str, Target] = {
    "se3_exp": Target(
        "directshape_torch/geometry/se3.py",
        (
            "hat",
            "generators",
            "_exp_coefficients",
            "_higher_exp_coefficients",
            "exp",
            "from_rotation_translation",
        ),
        _SE3_TESTS,
    ),
    "se3_group": Target("directshape_torch/geometry/se3.py", ("inverse", "transform", "adjoint"), _SE3_TESTS),
    "se3_log": Target("directshape_torch/geometry/se3.py", ("so3_log", "_quaternion", "log"), _SE3_TESTS),
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
    "silhouette_term": Target(
        "directshape_torch/energy/silhouette_term.py",
        tuple(
            f"SilhouetteTerm.{name}"
            for name in (
                "at_stage",
                "pixel_residual",
                "residual_at",
                "_rows",
                "_rows_closest_approach",
                "_by_sdf",
                "_rows_product",
                "accumulate",
                "weight",
                "_residual_of_a_miss",
            )
        ),
        ("tests/energy/test_silhouette_sums.py", *_ROWS, "tests/energy/test_constant_sets.py"),
    ),
    "photometric_term": Target(
        "directshape_torch/energy/photometric_term.py",
        tuple(
            f"PhotometricTerm.{name}"
            for name in (
                "jacobian",
                "linearise",
                "accumulate",
                "_depth_and_residual",
                "_norm_and_weight",
                "_linearisation",
                "weight",
                "_weighted_cost",
            )
        ),
        ("tests/energy/test_photometric_sums.py", *_ROWS, "tests/energy/test_constant_sets.py"),
    ),
    "tracking_blocks": Target(
        "directshape_torch/tracking/blocks.py",
        (
            "Blocks.join",
            "Blocks.of_objects",
            "WeightedBlocks.of",
            "WeightedBlocks.sums",
            "WeightedBlocks._sum",
            "PackedBlocks.of_rows",
            "weighted_products",
        ),
        ("tests/tracking/test_blocks.py",),
    ),
    "tracking_rays": Target(
        "directshape_torch/tracking/rays.py",
        (
            "BlockRays.of_pixels",
            "BlockRays.select",
            "BlockRays.of_blocks",
            "BlockRays.in_objects",
            "ObjectBlockRays.at",
            "ObjectBlockRays.depth_next_to",
            "ObjectBlockRays.interval",
        ),
        ("tests/tracking/test_block_rays.py",),
    ),
    "tracking_field": Target(
        "directshape_torch/tracking/field.py",
        (
            "GridBlockField.value",
            "GridBlockField.derivatives",
            "PackedBlockField.value",
            "PackedBlockField.derivatives",
            "block_field",
            "_packed",
        ),
        ("tests/tracking/test_block_fields.py",),
    ),
    "tracking_silhouette": Target(
        "directshape_torch/tracking/silhouette.py",
        (
            "SilhouetteRows.select",
            "linearise_silhouettes",
            "_of_grids",
            "_of_any",
            "accumulate_silhouettes",
            "closest_depth",
            "silhouette_residuals",
            "_residual_and_jacobian",
            "_of_a_miss",
        ),
        ("tests/tracking/test_tracking_silhouette.py",),
    ),
    "tracking_photometric": Target(
        "directshape_torch/tracking/photometric.py",
        (
            "PhotometricRows.select",
            "RightView.select",
            "linearise_photometric",
            "_of_grids",
            "_of_any",
            "accumulate_photometric",
            "_norm_and_weight",
            "_cost",
            "surface_under",
            "_secant_slope",
            "depth_of_state",
            "photometric_residuals",
            "_is_hidden",
        ),
        tuple(f"tests/tracking/test_tracking_{name}.py" for name in ("surface", "residuals", "photometric")),
    ),
    "tracked_silhouettes": Target(
        "directshape_torch/energy/tracked_silhouettes.py",
        (
            "TrackedSilhouettes.of_terms",
            "TrackedSilhouettes.linearise",
            "TrackedSilhouettes.fixed_depths",
            "TrackedSilhouettes.residuals",
            "TrackedSilhouettes.accumulate",
            "TrackedSilhouettes.follow",
            "TrackedSilhouettes.of_objects",
            "TrackedSilhouettes._noted",
            "_side",
        ),
        (
            f"{_TRACKED}::test_sums_of_the_silhouettes_ray_by_ray",
            f"{_TRACKED}::test_a_ray_that_misses_the_bounds_waits_by_their_middle",
            f"{_TRACKED}::test_factors_of_single_cars",
            *_FOLLOWING,
            f"{_TRACKED}::test_hand_derived_rows_are_those_of_autograd",
        ),
    ),
    "tracked_photometric": Target(
        "directshape_torch/energy/tracked_photometric.py",
        (
            "TrackedPhotometric.of_term",
            "TrackedPhotometric.linearise",
            "TrackedPhotometric.fixed_depths",
            "TrackedPhotometric.residuals",
            "TrackedPhotometric.accumulate",
            "TrackedPhotometric.follow",
            "TrackedPhotometric.of_objects",
            "TrackedPhotometric._noted",
            "_rows",
            "_right_view",
            "_hidden",
            "_hits",
        ),
        (
            f"{_TRACKED}::test_where_a_stage_begins_the_photometric_rows_are_the_marched_ones",
            f"{_TRACKED}::test_at_any_depth_a_pixel_lands_where_the_marched_one_does",
            f"{_TRACKED}::test_photometric_rows_a_step_away",
            f"{_TRACKED}::test_factors_of_single_cars",
            *_FOLLOWING,
            f"{_TRACKED}::test_a_pixel_that_comes_to_be_hidden_or_leaves_the_image_pays_as_the_marched_one",
            f"{_TRACKED}::test_hand_derived_rows_are_those_of_autograd",
        ),
    ),
    "tracked_energy": Target(
        "directshape_torch/energy/tracked_energy.py",
        (
            "TrackedEnergy.of_terms",
            "TrackedEnergy.linearise",
            "TrackedEnergy.linearise_by_autograd",
            "TrackedEnergy._of_parts",
            "TrackedEnergy._summed",
            "TrackedEnergy.follow",
            "TrackedEnergy.of_objects",
            "are_tracked",
            "_stacked",
        ),
        (
            f"{_TRACKED}::test_the_terms_that_are_tracked_and_the_others",
            f"{_TRACKED}::test_a_class_made_from_a_term_is_asked_itself",
            f"{_TRACKED}::test_factors_of_single_cars",
            *_FOLLOWING,
            f"{_TRACKED}::test_hand_derived_rows_are_those_of_autograd",
        ),
    ),
    "factors": Target(
        "directshape_torch/energy/term.py",
        ("scaled", "total_of", "sum_of"),
        (f"{_TRACKED}::test_factors_of_single_cars",),
    ),
    "pose_rows": Target(
        "directshape_torch/energy/pose_rows.py",
        (
            "pose_features",
            "beside_codes",
            "heading_constants",
            "position_rows",
            "level_rows",
            "cosine_rows",
            "heading_rows",
            "without_heading",
            "_put_normal",
        ),
        ("tests/energy/test_stacked_priors.py",),
    ),
    "stacked_priors": Target(
        "directshape_torch/energy/stacked_priors.py",
        (
            "_Dimensions.rows",
            "_Dimensions.of_objects",
            "StackedPriors.from_terms",
            "StackedPriors.parts",
            "StackedPriors.of_objects",
            "_roots_of_weights",
            "_pose_rows",
            "_code_rows",
            "_dimensions",
        ),
        ("tests/energy/test_stacked_priors.py",),
    ),
    "point_cloud_term": Target(
        "directshape_torch/energy/point_cloud_term.py",
        ("PointCloudTerm.cost", "PointCloudTerm.accumulate", "PointCloudTerm._weight"),
        ("tests/energy/test_point_cloud_term.py",),
    ),
    "held_unknowns": Target(
        "directshape_torch/energy/stage_unknowns.py",
        ("moving_unknowns", "without_held"),
        ("tests/energy/test_point_cloud_term.py",),
    ),
    "prior_terms": Target(
        "directshape_torch/energy/prior_terms.py",
        tuple(f"PriorTerm.{name}" for name in ("cost", "jacobian", "linearise", "accumulate", "_rows")),
        ("tests/energy/test_prior_sums.py", *_ROWS[:1], "tests/energy/test_terms.py"),
    ),
    "rays_of_a_state": Target(
        "directshape_torch/energy/projected_state.py",
        (
            "ProjectedView.__init__",
            "ProjectedView._gradient_at_entry",
            "ProjectedView.surface_gradient",
            "ProjectedView.seen_surface",
            "ProjectedView._is_plain",
            "ProjectedView._not_grazing",
        ),
        ("tests/energy/test_rays_of_a_state.py", f"{_COST}::test_g_is_the_gradient_of_the_reported_cost"),
    ),
    "covariance": Target(
        "directshape_torch/covariance.py",
        ("tangent_covariance", "covariance_xyz_yaw"),
        ("tests/test_covariance.py",),
    ),
}
