"""This module lists functions with hand-derived derivatives, tests that must catch mistakes, and equivalents."""

from __future__ import annotations

from dataclasses import dataclass

from jacobian_mutants.mutants import Mutant


@dataclass(frozen=True)
class Target:
    """A `Target` has functions of one file (`Class.method` for methods) and their tests, the fastest first."""

    path: str
    functions: tuple[str, ...]
    tests: tuple[str, ...]


_LABORATORY = "tests/laboratory/test_three_ways.py"
_MINIMUM = "tests/shape/test_ray_minimum.py::test_minimum_and_first_hit_are_the_references"
_SUMS = (
    f"{_LABORATORY}::test_sums_are_those_of_single_residuals",
    "tests/terms/test_point_cloud.py::test_the_fisher_matrix_has_the_weight_that_the_norm_gives_it",
)
_JACOBIANS = (
    f"{_LABORATORY}::test_linear_is_the_derivative_of_residual_in_every_regime",
    f"{_LABORATORY}::test_terms_against_differences",
)
_TRACK = tuple(f"{name}[track]" for name in _JACOBIANS)
_GRADIENTS = (*_JACOBIANS, f"{_LABORATORY}::test_gradients_can_be_differentiated")
_OFFSET = tuple(
    f"tests/terms/test_disparity_offset.py::test_{name}"
    for name in ("warp_and_prior_by_hand", "an_offset_does_what_a_constant_field_does")
)

TARGETS: dict[str, Target] = {
    "silhouettes": Target(
        "directshape_torch/terms/silhouette.py",
        (
            "Silhouettes.linear",
            "Silhouettes.residual",
            "Silhouettes._of_distance",
            "closest_approach_residual",
            "sdf_state_jacobian",
        ),
        (*_JACOBIANS, "tests/terms/test_silhouette.py"),
    ),
    "silhouette_products": Target(
        "directshape_torch/terms/silhouette.py",
        ("SilhouetteProducts.linear", "SilhouetteProducts.residual", "product_residual"),
        (*_JACOBIANS, "tests/terms/test_silhouette.py::test_products_are_the_same_with_gradients_on"),
    ),
    "photometric": Target(
        "directshape_torch/terms/photometric.py",
        ("Photometric.linear", "Photometric.residual", "warped_depth", "near_surface", "depth_of"),
        (*_OFFSET, *_GRADIENTS, f"{_LABORATORY}::test_a_tracked_pixel_ends_on_the_surface"),
    ),
    "photometric_rows": Target(
        "directshape_torch/terms/photometric_rows.py",
        ("compared", "warped_pixels"),
        (*_OFFSET, *_GRADIENTS, "tests/terms/test_photometric_rows.py", "tests/terms/test_photometric.py"),
    ),
    "point_cloud": Target(
        "directshape_torch/terms/point_cloud.py",
        ("PointCloud.linear", "PointCloud.residual", "PointCloud._points_obj"),
        (*_JACOBIANS, "tests/terms/test_point_cloud.py"),
    ),
    "priors": Target(
        "directshape_torch/terms/priors.py",
        (
            "PriorTerm.linear",
            "shape_prior",
            "height_prior",
            "tilt_prior_normal",
            "tilt_prior_cosine",
            "dimensions_prior",
            "pose_prior",
            "rig_prior",
            "J_heading_omega",
        ),
        (*_OFFSET[:1], "tests/terms/test_priors.py", *_JACOBIANS),
    ),
    "motion": Target(
        "directshape_torch/tracks/path.py",
        ("path_prior", "acceleration_prior", "_on_the_ground", "_basis"),
        (*_TRACK, "tests/tracks/test_path.py"),
    ),
    "next_view": Target(
        "directshape_torch/tracks/next_view.py",
        ("NextView.linear", "NextView.residual", "NextView.looked_up"),
        (*_TRACK, "tests/tracks/test_next_view.py"),
    ),
    "robust": Target(
        "directshape_torch/terms/robust.py",
        ("quadratic", "huber", "identity"),
        ("tests/terms/test_robust.py",),
    ),
    "depth": Target(
        "directshape_torch/terms/depth.py",
        ("along_face", "attached_closest_depth", "surface_depth"),
        _GRADIENTS,
    ),
    "ray_minimum": Target(
        "directshape_torch/shape/sdf_grid.py",
        ("GridShape.minimum_along", "GridShape.curvature_along", "_cells_along", "_derivatives_along", "_first_root"),
        (
            f"{_LABORATORY}::test_rays_are_closest_where_they_are_said_to_be",
            "tests/shape/test_ray_minimum.py",
            *_GRADIENTS,
        ),
    ),
    "sums": Target("directshape_torch/rows.py", ("CarSums.of", "CarSums.sum"), _SUMS),
    "term_sums": Target(
        "directshape_torch/terms/term.py",
        ("part_of", "part_of_rows", "_block_costs", "weighted_products", "summed", "by_autograd"),
        _SUMS,
    ),
    "stage_sums": Target(
        "directshape_torch/refinement/problem.py",
        ("CarStage.figures", "CarIterations.evaluated", "_Layout.of"),
        _SUMS,
    ),
    "se3": Target(
        "directshape_torch/geometry/se3.py",
        (
            "generators",
            "_higher_exp_coefficients",
            "exp",
            "from_rotation_translation",
            "inverse",
            "transform",
            "from_kornia",
            "to_kornia",
        ),
        ("tests/geometry/test_se3.py",),
    ),
    "unknowns": Target(
        "directshape_torch/state/unknowns.py",
        ("Block.moved", "Unknowns.span", "Unknowns.placed", "Unknowns.retract", "Unknowns.derivative"),
        (*_OFFSET[:1], "tests/state/test_unknowns.py", *_JACOBIANS),
    ),
    "offset": Target("directshape_torch/state/cars.py", ("CarBatch.inverse_depth_of_offset",), _OFFSET),
    "projection": Target(
        "directshape_torch/geometry/projection.py",
        ("rays_from_pixels", "project", "right_rays"),
        ("tests/geometry/test_stereo.py",),
    ),
    "stereo_depth": Target(
        "directshape_torch/geometry/stereo_depth.py", ("warp_to_right",), ("tests/geometry/test_stereo.py",)
    ),
    "bilinear": Target(
        "directshape_torch/image/interpolate.py",
        ("bilinear_patch", "_cell"),
        ("tests/image/test_interpolate.py",),
    ),
    "sdf_grid": Target(
        "directshape_torch/shape/sdf_grid.py",
        (
            "GridShape.of",
            "GridShape.value",
            "GridShape.value_and_derivatives",
            "GridShape.sdf",
            "GridShape.derivatives",
            "GridShape.gradient",
            "_value_and_gradient",
            "_interpolated",
            "_between",
            "_summed",
            "positions",
            "steps",
            "lower_nodes",
            "nodes_of",
            "at_corners",
            "Cells.outward",
            "cells_at",
            "corner_values",
            "halves",
        ),
        ("tests/shape/test_sdf_grid.py",),
    ),
    "short_axes": Target(
        "directshape_torch/numerics/tensors.py",
        ("length", "all_along"),
        ("tests/numerics/test_tensors.py",),
    ),
    "bracket": Target(
        "directshape_torch/terms/depth.py",
        ("Bracket.between", "Bracket.probed", "_line_zero"),
        ("tests/shape/test_ray_minimum.py", _MINIMUM),
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
}


@dataclass(frozen=True)
class Equivalent:
    """An `Equivalent` is mutants of a function with an equal result: of this text, to `after` or, if None, to any."""

    function: str
    before: str
    after: str | None
    reason: str

    def matches(self, mutant: Mutant) -> bool:
        same = mutant.function == self.function and mutant.before == self.before
        return same and self.after in (None, mutant.after)


_OF_ZERO = "the negative of zero is zero"
_IN_PAIRS = "enters as a square, or twice as a factor"

EQUIVALENTS: tuple[Equivalent, ...] = (
    Equivalent("exp", "torch.bmm(X2, X)", "(torch.bmm(X, X2))", "powers of one matrix commute"),
    Equivalent("GridShape.value_and_derivatives", "nothing_is_differentiated()", None, "only its truth is asked for"),
    Equivalent("SilhouetteProducts.linear", "nothing_is_differentiated()", None, "only its truth is asked for"),
    Equivalent(
        "near_surface", "anchor.depth", "(-anchor.depth)", "a hit is tracked from its point, not from its depth"
    ),
    Equivalent("near_surface", "-1.0", "(1.0)", "of rays without a surface, whose quotient nobody asks for"),
    Equivalent("depth_of", "-1.0", "(1.0)", "of rays without a surface, whose quotient nobody asks for"),
    *(
        Equivalent("part_of_rows", text, f"(-{text})", "the iterations, whose witness it is, never ask for it")
        for text in ("products[:, :-1]", "residual")
    ),
    Equivalent("warped_depth", "ratio", "(-ratio)", _IN_PAIRS),
    Equivalent("_Layout.of", "terms[0]", "terms[1]", "all terms are of the same cars"),
    Equivalent("at_corners", "k * z", "(k)", "the stride of the last axis is one"),
    *(
        Equivalent("lower_nodes", text, None, "the upper limit is for processors that make NaN a large number")
        for text in (
            "math.prod(grid.basis.shape[:3]) - 1",
            "math.prod(grid.basis.shape[:3]) - 1 - sum(strides(grid))",
        )
    ),
    *(
        Equivalent("GridShape.minimum_along", text, f"({wider})", "of a ray beyond the border nothing is used")
        for text, wider in (
            ("self.values.numel() - 1", "self.values.numel() + 1"),
            ("self.values.numel() - 1", "self.values.numel()"),
            ("self.values.numel() - 1 - sum(strides(self))", "self.values.numel() - 1 + sum(strides(self))"),
            ("self.values.numel() - 1 - sum(strides(self))", "self.values.numel() - 1"),
        )
    ),
    *(
        Equivalent(function, text, f"(-({text}))", "residual and Jacobian change sign together")
        for function, text in (
            ("path_prior", "1 / deviation_sigma(config, cars.time_s)"),
            ("acceleration_prior", "1 / state.path.new_tensor(sigma)"),
        )
    ),
    *(
        Equivalent(function, text, f"(-{wrapped})", "of a face's normal over its product with the ray the sign is gone")
        for function, text, wrapped in (
            ("attached_closest_depth", "closest.face_obj", "closest.face_obj"),
            ("GridShape.minimum_along", "1 - goes_on", "(1 - goes_on)"),
        )
    ),
    Equivalent("_on_the_ground", "R", "(-R)", f"in J_heading_omega it {_IN_PAIRS}"),
    Equivalent("tilt_prior_normal", "zero", "(-zero)", _OF_ZERO),
    Equivalent("pose_prior", "R_cam_obj", "(-R_cam_obj)", f"in J_heading_omega it {_IN_PAIRS}"),
    Equivalent("_higher_exp_coefficients", "0.5 * angle", "(-(0.5 * angle))", "only the square of its sine is used"),
    Equivalent(
        "project",
        "K @ points_cam[..., None]",
        "(-(K @ points_cam[..., None]))",
        "both sides of the ratio u = h_x / h_z change sign",
    ),
)


def reason_for(mutant: Mutant) -> str | None:
    """The reason why a mutant is excluded, or None if it is not."""
    return next((e.reason for e in EQUIVALENTS if e.matches(mutant)), None)
