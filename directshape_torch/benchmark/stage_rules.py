"""Which part of a refinement a function belongs to.

The first rule whose module and name match decides. Helpers, and everything outside this package, belong to whoever
called them. A function of this package that neither a rule nor a helper matches is unattributed and shows up as such.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Stage = Literal[
    "sampling",
    "shape binding",
    "silhouette value",
    "silhouette Jacobian",
    "ray depth",
    "warp",
    "priors",
    "normal equations",
    "solve",
    "outcome",
    "bookkeeping",
    "unattributed",
]

STAGES: dict[Stage, str] = {
    "sampling": "regions, gradients, occlusion, pixels of the images, pixel sets of the stages",
    "shape binding": "grids of the cars from their codes",
    "silhouette value": "rays, their points of closest approach, residuals",
    "silhouette Jacobian": "derivatives at those points",
    "ray depth": "where rays enter the shape, and the derivative of that depth",
    "warp": "from the left image to the right, residuals, brightness",
    "priors": "shape, ground, dimensions, pose",
    "normal equations": "sums over the pixels of each car",
    "solve": "damped step and new state",
    "outcome": "covariance, quality, profile, trust, with all that they evaluate",
    "bookkeeping": "the loop, compaction, checks, assembling the result",
    "unattributed": "functions that no rule knows",
}

PACKAGE = "directshape_torch"


@dataclass(frozen=True)
class Rule:
    """Functions of the modules that match, by their qualified names.

    Attributes:
        module: regular expression of the whole module name below the package.
        function: regular expression that occurs in the qualified name.
        stage: they belong to; None for helpers.
        encloses: whatever they call belongs to it as well.
    """

    module: str
    function: str
    stage: Stage | None
    encloses: bool = False

    def matches(self, module: str, function: str) -> bool:
        return re.fullmatch(self.module, module) is not None and re.search(self.function, function) is not None


_ANY = ""
_OUTCOME = r"outcome|quality|covariance|observability|evidence|disparity_profile|photometric_match|trust_model"

RULES = (
    Rule(r"observation\..*|initial_search", _ANY, "sampling"),
    Rule(r"stereo_matching\..*", _ANY, "sampling"),
    Rule(r"energy\.photometric_term", r"at_stage|_fix", "sampling"),
    Rule(r"energy\.photometric_pixels", _ANY, "sampling"),
    Rule(r"shape\..*", r"\bbind\b|initial_code", "shape binding"),
    Rule(r"shape\.raycast", r"march|closest|_least", "silhouette value"),
    Rule(r"shape\.raycast", r"crossing|false_position|polished|depth|newton", "ray depth"),
    Rule(r"energy\.projected_state", r"surface|entry|grazing", "ray depth"),
    Rule(r"energy\.projected_state", _ANY, "silhouette value"),
    Rule(r"energy\.silhouette_term", r"_rows_|_by_sdf|jacobian", "silhouette Jacobian"),
    Rule(r"residuals\.silhouette", r"derivative", "silhouette Jacobian"),
    Rule(r"(energy|residuals)\.silhouette.*", _ANY, "silhouette value"),
    Rule(r"residuals\.photometric", r"depth_state_jacobian|surface_slope", "ray depth"),
    Rule(r"residuals\.photometric_profile", r"warp_lines", "sampling"),
    Rule(r"(energy|residuals)\.photometric.*|energy\.brightness", _ANY, "warp"),
    Rule(r"(energy|residuals)\.(prior|stacked_priors|pose_rows|point_cloud).*", _ANY, "priors"),
    Rule(r"tracking\.blocks", r"weighted_products|sums", "normal equations"),
    Rule(r"tracking\.(silhouette|photometric)", r"accumulate", "normal equations"),
    Rule(r"tracking\.silhouette", r"_residual_and_jacobian", "silhouette Jacobian"),
    Rule(r"tracking\.silhouette", _ANY, "silhouette value"),
    Rule(r"tracking\.photometric", r"surface_under|depth_of_state", "ray depth"),
    Rule(r"tracking\.photometric", _ANY, "warp"),
    Rule(r"energy\.(car_state|car_problem|tracked_problem)", r"retract", "solve"),
    Rule(r"energy\.tracked_.*", _ANY, "bookkeeping"),
    Rule(r"solver\.normal_equations", _ANY, "normal equations"),
    Rule(r"solver\.damped_solve", _ANY, "solve"),
    Rule(r"outcome", r"assemble|nothing", "bookkeeping"),
    Rule(_OUTCOME, _ANY, "outcome", encloses=True),
    Rule(r"refiner|admission|result|status|backward|checks|config.*|scene", _ANY, "bookkeeping"),
    Rule(r"solver\..*|energy\.(car_.*|term|method|.*_terms|stage_unknowns|unchanged|end_.*)", _ANY, "bookkeeping"),
    Rule(r"geometry\..*|image\..*|shape\..*|tracking\.(blocks|field|rays)", _ANY, None),
    Rule(
        r"residuals\.(robust|state_chain)|compil.*|device_constants|full_precision|car_rows|.*_(lookup|mode)",
        _ANY,
        None,
    ),
)


UNKNOWN = Rule(_ANY, _ANY, "unattributed")
OF_CALLER = Rule(_ANY, _ANY, None)


def rule_of(module: str, function: str) -> Rule:
    """The rule that decides for a function.

    Args:
        module: its full name.
        function: its qualified name.

    Returns:
        One without a stage for functions that belong to their caller's.

    Example:
        >>> rule_of("directshape_torch.solver.damped_solve", "damped_step").stage
        'solve'
        >>> rule_of("torch.functional", "einsum").stage is None
        True
        >>> rule_of("directshape_torch.brand_new", "f").stage
        'unattributed'
    """
    package, _, inner = module.partition(".")
    if package != PACKAGE:
        return OF_CALLER
    return next((rule for rule in RULES if rule.matches(inner, function)), UNKNOWN)
