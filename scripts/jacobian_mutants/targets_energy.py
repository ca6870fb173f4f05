"""Targets of the mutation script: functions of the terms of the energy, tracked ones too."""

from __future__ import annotations

from jacobian_mutants.target import Target

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

TARGETS: dict[str, Target] = {
    "silhouette_term": Target(
        "directshape_torch/energy/silhouette_term.py",
        (
            "_closest_approach_of_sides",
            *(
                f"SilhouetteTerm.{name}"
                for name in (
                    "at_stage",
                    "pixel_residual",
                    "residual_at",
                    "_rows",
                    "_crossing_rows",
                    "_rows_closest_approach",
                    "_by_sdf",
                    "_rows_product",
                    "accumulate",
                    "weight",
                    "_residual_of_a_miss",
                )
            ),
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
                "fisher_factor",
                "weight",
                "_weighted_cost",
            )
        ),
        ("tests/energy/test_photometric_sums.py", *_ROWS, "tests/energy/test_constant_sets.py"),
    ),
    "end_blocks": Target(
        "directshape_torch/energy/end_blocks.py",
        ("EndBlocks.of", "EndBlocks.linearise", "EndBlocks._photometric", "EndBlocks._priors", "EndBlocks._by_terms"),
        ("tests/energy/test_end_linearisation.py",),
    ),
    "end_linearisation": Target(
        "directshape_torch/energy/end_linearisation.py",
        ("EndLinearisation.of_parts", "EndLinearisation.plus", "_sum"),
        ("tests/energy/test_end_linearisation.py", "tests/energy/test_point_cloud_term.py"),
    ),
    "tracking_blocks": Target(
        "directshape_torch/tracking/blocks.py",
        (
            "Blocks.join",
            "Blocks.of_sides",
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
            "BlockRays.of_places",
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
            "_Seen.of",
            "_Seen.in_play",
            "_Seen.closest_points",
            "_weight",
            "_cost_at_rest",
        ),
        (
            f"{_TRACKED}::test_sums_of_the_silhouettes_ray_by_ray",
            f"{_TRACKED}::test_a_ray_that_crosses_the_bounds_begins_where_its_march_was_closest",
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
