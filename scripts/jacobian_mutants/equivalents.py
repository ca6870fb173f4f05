"""Mutants that no test can tell from the original, each with the reason why. Everything else must be caught."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from jacobian_mutants.mutants import Mutant


@dataclass(frozen=True)
class Equivalent:
    """Mutants of a function that compute the same: those of this text, to `after` or, where None, to anything."""

    function: str
    before: str
    after: str | None
    reason: str

    def matches(self, mutant: Mutant) -> bool:
        same = mutant.function == self.function and mutant.before == self.before
        return same and self.after in (None, mutant.after)


_OF_ZERO = "the negative of zero is zero"
_BRANCH_NOT_TAKEN = "a stand-in where the other branch is taken: neither its value nor its derivative gets anywhere"
_SQUARED = "the floor of the contrast enters as a square"
_FLAG = "a flag, whose truth a sign leaves alone"
_ROW_IN_PAIRS = "a residual changes its sign with its Jacobian, and both enter as products of two"
_IN_PAIRS = "enters as a square, or twice as a factor"
_FOR_SPEED = "a threshold that only saves work: what it leaves out is below the rounding of the sum"
_VALUE_UNUSED = "carried along with the derivatives, and the Jacobian does not depend on it"
_THRESHOLD = "self.zeta[:, None] * torch.exp(torch.as_tensor(_NEGLIGIBLE_LOG_WEIGHT, dtype=self.zeta.dtype))"

_IN_ANOTHER_ORDER = "a sum in another order"

EQUIVALENTS: tuple[Equivalent, ...] = (
    Equivalent(
        "EndBlocks.linearise",
        "(self._photometric(projected), self._priors(projected), self._by_terms(projected))",
        None,
        _IN_ANOTHER_ORDER,
    ),
    Equivalent("EndLinearisation.plus", "[self.fisher_seen, other.fisher_seen]", None, _IN_ANOTHER_ORDER),
    Equivalent(
        "EndLinearisation.plus", "[self.photometric_gradient, other.photometric_gradient]", None, _IN_ANOTHER_ORDER
    ),
    Equivalent("exp", "torch.bmm(X2, X)", "(torch.bmm(X, X2))", "powers of one matrix commute"),
    Equivalent("tilt_prior_normal", "zero", "(-zero)", _OF_ZERO),
    Equivalent("viewing_axes", "zero", "(-zero)", _OF_ZERO),
    Equivalent("_by_rotation", "zeros[..., :3]", "(-zeros[..., :3])", _OF_ZERO),
    Equivalent("_by_rotation", "zeros[..., 3:]", "(-zeros[..., 3:])", _OF_ZERO),
    Equivalent("dimensions_prior", "no_twist", "(-no_twist)", _OF_ZERO),
    *(
        Equivalent("SilhouetteTerm._rows_product", _THRESHOLD, after, _FOR_SPEED)
        for after in (f"(-({_THRESHOLD}))", f"({_THRESHOLD.removeprefix('self.zeta[:, None] * ')})")
    ),
    Equivalent("ProjectedView.__init__", "moving_depths", "(-moving_depths)", _FLAG),
    Equivalent("TrackedPhotometric.of_term", "config.truncated", "(-config.truncated)", _FLAG),
    Equivalent("heading_constants", "zero", "(-zero)", _OF_ZERO),
    Equivalent("_hidden", "nowhere", "(-nowhere)", _OF_ZERO),
    Equivalent("_hidden", "nowhere[:, :1]", "(-nowhere[:, :1])", _OF_ZERO),
    Equivalent("_hidden", "nowhere[:, :1]", "nowhere[:, 1:2]", "another column of the same zeros"),
    Equivalent("_Seen.of", "view.closest_sdf", "(-view.closest_sdf)", "its size alone is asked for"),
    Equivalent("compiled_entry", "parts[1:]", "(-parts[1:])", "the gradient there depends on the depth alone"),
    Equivalent("probe_grids", "basis", "(-basis)", "its shape alone is asked for"),
    Equivalent("are_tracked", "(*sides, *photometric)", "(*photometric, *sides)", "only membership is asked"),
    Equivalent(
        "_Dimensions.rows",
        "torch.cat([at.J_hwl_code.to(torch.float64), residual], dim=2) * self.scale",
        "(-(torch.cat([at.J_hwl_code.to(torch.float64), residual], dim=2) * self.scale))",
        _ROW_IN_PAIRS,
    ),
    Equivalent("StackedPriors.from_terms", "terms[0]", "terms[1]", "all priors of a batch know the same cars"),
    *(
        Equivalent("StackedPriors.parts", before, f"(-{before})", _ROW_IN_PAIRS)
        for before in ("of_pose.view(len(code), of_pose.shape[1] // columns, columns)", "of_code")
    ),
    Equivalent(
        "StackedPriors.parts",
        "[of_pose.view(len(code), of_pose.shape[1] // columns, columns), of_code]",
        "[of_code, of_pose.view(len(code), of_pose.shape[1] // columns, columns)]",
        "the order of the rows, over which everything is summed",
    ),
    Equivalent(
        "StackedPriors.of_objects",
        "self.pose_rows.index_select(0, index)",
        "(-self.pose_rows.index_select(0, index))",
        _ROW_IN_PAIRS,
    ),
    Equivalent(
        "_roots_of_weights", "math.sqrt(term.weight) * ones", "(-(math.sqrt(term.weight) * ones))", _ROW_IN_PAIRS
    ),
    Equivalent(
        "_roots_of_weights",
        "root * factor.to(torch.float64).sqrt()",
        "(-(root * factor.to(torch.float64).sqrt()))",
        _ROW_IN_PAIRS,
    ),
    Equivalent("_pose_rows", "root / normal[:, 1]", "(-(root / normal[:, 1]))", _ROW_IN_PAIRS),
    Equivalent("_pose_rows", "root[:, None] * normal", "(-(root[:, None] * normal))", _ROW_IN_PAIRS),
    Equivalent(
        "_pose_rows",
        "root[:, None] / detector_pose_sigma(config, cars)",
        "(-(root[:, None] / detector_pose_sigma(config, cars)))",
        _ROW_IN_PAIRS,
    ),
    Equivalent(
        "_pose_rows",
        "scale[:, :3, None] * viewing_axes(origin)",
        "(-(scale[:, :3, None] * viewing_axes(origin)))",
        _ROW_IN_PAIRS,
    ),
    Equivalent(
        "_pose_rows",
        "[position_rows(axes, -(axes @ origin[..., None])[..., 0]), heading_rows(scale[:, 3])]",
        "[heading_rows(scale[:, 3]), position_rows(axes, -(axes @ origin[..., None])[..., 0])]",
        "the order of the rows, over which everything is summed",
    ),
    Equivalent(
        "_pose_rows",
        "position_rows(axes, -(axes @ origin[..., None])[..., 0])",
        "(-position_rows(axes, -(axes @ origin[..., None])[..., 0]))",
        _ROW_IN_PAIRS,
    ),
    Equivalent("_pose_rows", "heading_rows(scale[:, 3])", "(-heading_rows(scale[:, 3]))", _ROW_IN_PAIRS),
    Equivalent(
        "_code_rows",
        "root[:, None, None] * torch.eye(num_codes, num_codes + 1, dtype=root.dtype, device=root.device)",
        "(-(root[:, None, None] * torch.eye(num_codes, num_codes + 1, dtype=root.dtype, device=root.device)))",
        _ROW_IN_PAIRS,
    ),
    Equivalent(
        "_dimensions",
        "root[:, None] / constant_like(sigma_hwl_m, root)",
        "(-(root[:, None] / constant_like(sigma_hwl_m, root)))",
        _ROW_IN_PAIRS,
    ),
    Equivalent("_higher_exp_coefficients", "0.5 * angle", "(-(0.5 * angle))", "only the square of its sine is used"),
    Equivalent(
        "project",
        "K @ points_cam[..., None]",
        "(-(K @ points_cam[..., None]))",
        "both sides of the ratio u = h_x / h_z change sign",
    ),
    Equivalent(
        "closest_depth",
        "SAMPLE_DISTANCE_M / length(rays.direction_obj, dim=0)",
        "(-(SAMPLE_DISTANCE_M / length(rays.direction_obj, dim=0)))",
        "the three samples lie symmetric about the depth, so the slope changes its sign with the step",
    ),
    Equivalent("_residual_and_jacobian", "at.value", "(-at.value)", _VALUE_UNUSED),
    Equivalent("surface_under", "at.value", "(-at.value)", _VALUE_UNUSED),
    *(
        Equivalent(function, f"{owner}.contrast_floor_grey_levels", f"(-{owner}.contrast_floor_grey_levels)", _SQUARED)
        for function, owner in (("photometric_residuals", "settings"), ("TrackedPhotometric.of_term", "config"))
    ),
    Equivalent("log_one_minus_exp", "-0.5", "(0.5)", _BRANCH_NOT_TAKEN),
    Equivalent("log_one_minus_exp", "-1.0", "(1.0)", _BRANCH_NOT_TAKEN),
    *(
        Equivalent("patch_derivative", text, f"(-{text})" if text.startswith("_") else f"(-({text}))", _IN_PAIRS)
        for text in (
            "_centred(intensity_left, weight)",
            "_centred(residual + intensity_left, weight)",
            "residual + intensity_left",
            "right / contrast",
        )
    ),
    Equivalent(
        "residual_derivative_closest_approach",
        "zeta * closest_sdf",
        "(-(zeta * closest_sdf))",
        "only its magnitude is compared with the saturation",
    ),
)


def reason_for(mutant: Mutant, equivalents: Iterable[Equivalent] = EQUIVALENTS) -> str | None:
    """Why a mutant is excluded; None where it is not."""
    return next((e.reason for e in equivalents if e.matches(mutant)), None)
