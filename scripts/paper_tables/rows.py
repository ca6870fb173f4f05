"""How rows of the tables are refined, as data: settings, the methods of the pose table, the rows of the ablation.

A row with `start` other than "main" begins from other detections: "mono" (a detector of the data set with `mono` in its
name) or "noise:S" (labels disturbed S times as much as stereo-like detections, see `simulated_lines`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Masks = Literal["true", "left", "boxes", "degraded"]
Exposure = Literal["true", "flatter", "vignetted"]

_ACCEPT_ALL = ("acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0")


@dataclass(frozen=True)
class Settings:
    """One way to refine.

    Attributes:
        overrides: `key=value`, as for `directshape refine --set`.
        config: bundled settings that they change.
        prior: "pca", "neural", "pca:K" (its first K components), or a file.
        masks: "true" (the data set's own), "left" (those of the left images alone), "boxes" (the detector's 2D boxes,
            filled) or "degraded".
        with_field: use the residual disparity field where there is one.
        exposure: of the right images: "true" (as they are), "flatter" (0.8 of the contrast, 25 grey levels brighter) or
            "vignetted" (as they are at the left border, 0.65 of it at the right one); see `exposures`.
        every_result: return every result, so that rows compare methods and not whom they trust; False leaves the
            acceptance to the configuration, which may return the input instead.
    """

    overrides: tuple[str, ...] = ()
    config: str = "default"
    prior: str = "pca"
    masks: Masks = "true"
    with_field: bool = True
    exposure: Exposure = "true"
    every_result: bool = True

    @property
    def all_overrides(self) -> tuple[str, ...]:
        """The overrides, with acceptance switched off where every result is wanted."""
        return (*self.overrides, *(_ACCEPT_ALL if self.every_result else ()))

    @property
    def slug(self) -> str:
        """A short name for folders, readable rather than unique.

        Examples:
            >>> Settings(("silhouette.weight=0",), masks="degraded").slug
            'default-silhouette.weight-0-degraded'
        """
        parts = [self.config, *self.overrides]
        parts += [self.prior] if self.prior != "pca" else []
        parts += [self.masks] if self.masks != "true" else []
        parts += [] if self.with_field else ["no-field"]
        parts += [self.exposure] if self.exposure != "true" else []
        parts += [] if self.every_result else ["policy"]
        return re.sub(r"[^\w.]+", "-", "-".join(parts)).strip("-")[:60]


PAPER = Settings(config="paper")
DEFAULT = Settings()
FAST = Settings(config="fast")
TRUSTED = Settings(every_result=False)
GEOMETRIC = Settings(("method=geometric",))
COMBINED = Settings(("method=combined",))

METHODS: dict[str, Settings] = {
    "ours, `paper`": PAPER,
    "ours, `fast`": FAST,
    "ours, `default`": DEFAULT,
    "the same, input where not trusted": TRUSTED,
    "geometric, SGBM": GEOMETRIC,
    "combined": COMBINED,
}
"""The methods of the pose table, by the names they have there."""


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        group: rows that belong together.
        name: what differs.
        settings: of the refinement.
        start: the detections.
    """

    group: str
    name: str
    settings: Settings = DEFAULT
    start: str = "main"


_COARSE_POSE = "{contour_width_px: 2.0, image_level: 1, max_iterations: 6, over_relaxation: 1.6, unknowns: pose}"
_FINE_POSE = "{contour_width_px: 0.5, image_level: 0, max_iterations: 6, over_relaxation: 1.6, unknowns: pose}"
_NO_PRIORS = ("priors.shape_weight=0", "priors.height_weight=0", "priors.tilt_weight=0", "priors.dimensions_weight=0")
_SAMPLINGS = {
    name: (f"sampling.mode={mode}", f"sampling.mode_right={mode}")
    for name, mode in {"by gradient in the right image too": "adaptive", "uniform": "uniform"}.items()
}


def _steps(coarse: int, fine: int, over_relaxation: float) -> tuple[str, ...]:
    """Iterations of the two stages at most, and how long their steps are."""
    of_both = f"over_relaxation: {over_relaxation:g}"
    return (
        f"stages=[{{contour_width_px: 2.0, image_level: 1, max_iterations: {coarse}, {of_both}}}, "
        f"{{contour_width_px: 0.5, image_level: 0, max_iterations: {fine}, {of_both}}}]",
    )


_STEPS = {
    "6 and 6 plain steps": _steps(6, 6, 1.0),
    "10 and 12 over-relaxed steps": _steps(10, 12, 1.6),
    "30 and 30 plain steps": _steps(30, 30, 1.0),
}


_SEARCHES = {
    "headings +-20 degrees": ("search.yaw_offsets_deg=[-20, 20]",),
    "headings +-20 and 180 degrees": ("search.yaw_offsets_deg=[-20, 20, 180]",),
    "disparities +-1 and +-2 px": ("search.disparity_offsets_px=[-2, -1, 1, 2]",),
}


def _pose_sigmas(along_share: float, across_m: float, vertical_m: float, yaw_deg: float) -> Settings:
    """The detector's pose as a prior, with these standard deviations."""
    sigmas = {"along_share": along_share, "across_m": across_m, "vertical_m": vertical_m, "yaw_deg": yaw_deg}
    return Settings(tuple(f"priors.pose_sigma_{name}={value:g}" for name, value in sigmas.items()))


_PHOTOMETRY = {
    "factor and offset a car": ("photometric.brightness=affine",),
    "neighbourhoods without brightness": ("photometric.patch=zero_mean",),
    "neighbourhoods without brightness and contrast": ("photometric.patch=normalised",),
}
# Robust likelihoods: how sure a pixel of a mask can be at most is 0.99 by default.
_FLOORS = (0.05, 0.1)
_EXPOSURES: tuple[Exposure, ...] = ("flatter", "vignetted")


_RAYS = {
    "marched at every state": ("solver.rays=marched",),
    "tracked, converged below a decrease of 1e-4": ("solver.cost_tolerance=0.0001",),
    "marched, converged below a decrease of 1e-4": ("solver.rays=marched", "solver.cost_tolerance=0.0001"),
}


def _points(number: int) -> Settings:
    return Settings((f"sampling.min_pixels={number}", f"sampling.max_pixels={number}"))


def _floor(probability: float) -> tuple[str, ...]:
    return (f"silhouette.probability_floor={probability:g}",)


REFERENCE = Row("reference", "default settings, every result")

ROWS: tuple[Row, ...] = (
    REFERENCE,
    Row("acceptance", "input where not trusted (the default)", TRUSTED),
    Row("stereo", "without the residual disparity field", Settings(with_field=False)),
    Row("terms", "silhouette only", Settings(("photometric.weight=0",))),
    Row("terms", "photometric only", Settings(("silhouette.weight=0",))),
    Row("terms", "the paper's product silhouette", Settings(("silhouette.form=product",))),
    Row("terms", "one brightness for both images", Settings(("photometric.brightness=none",))),
    Row("terms", "images and point cloud", Settings(("method=combined",))),
    *(Row("photometry", name, Settings(overrides)) for name, overrides in _PHOTOMETRY.items()),
    *(
        Row(f"right image {exposure}", name, Settings(overrides, exposure=exposure))
        for exposure in _EXPOSURES
        for name, overrides in {"a factor a car (default)": (), **_PHOTOMETRY}.items()
    ),
    Row("priors", "no priors", Settings(_NO_PRIORS)),
    Row("priors", "no shape prior", Settings(("priors.shape_weight=0",))),
    Row("priors", "no prior on dimensions (the paper)", Settings(("priors.dimensions_weight=0",))),
    Row("priors", "no ground", Settings(("priors.height_weight=0", "priors.tilt_weight=0"))),
    Row("priors", "the detector's pose and its sigmas", _pose_sigmas(0.02, 0.1, 0.05, 4.0)),
    Row("occlusion", "no occlusion handling", Settings(("sampling.occlusion=false",))),
    Row("occlusion", "order by box bottoms (the paper)", Settings(("sampling.occlusion_order=box_bottom",))),
    *(Row("sampling", name, Settings(overrides)) for name, overrides in _SAMPLINGS.items()),
    *(Row("points a car", f"{number}", _points(number)) for number in (50, 100, 200, 400, 1000, 3000)),
    *(Row("steps", name, Settings(overrides)) for name, overrides in _STEPS.items()),
    Row("stages", "fine stage only", Settings((f"stages=[{_FINE_POSE.replace('pose', 'both')}]",))),
    *(Row("start states kept by cost", name, Settings(overrides)) for name, overrides in _SEARCHES.items()),
    *(Row("rays", name, Settings(overrides)) for name, overrides in _RAYS.items()),
    Row("shape", "mean shape, pose only", Settings((f"stages=[{_COARSE_POSE}, {_FINE_POSE}]",))),
    *(Row("shape", f"K = {number}", Settings(prior=f"pca:{number}")) for number in (1, 2, 3, 5)),
    Row("prior", "network (neural)", Settings(prior="neural")),
    Row("masks", "degraded", Settings(masks="degraded")),
    *(Row("masks", f"trusted to {1 - floor:g} only", Settings(_floor(floor))) for floor in _FLOORS),
    *(
        Row("masks", f"degraded, trusted to {1 - floor:g} only", Settings(_floor(floor), masks="degraded"))
        for floor in _FLOORS
    ),
    Row("masks", "left image only", Settings(masks="left")),
    Row("masks", "2D boxes for masks", Settings(masks="boxes")),
    *(Row("detector noise", f"{scale:g} times", start=f"noise:{scale:g}") for scale in (0.25, 0.5, 1, 2, 3, 4)),
    # As that noise is drawn, on the ground a fourth of a stereo detector's: see `simulated_detector`.
    Row("detector noise", "0.25 times, and its sigmas", _pose_sigmas(0.00625, 0.03, 0.05, 1.25), "noise:0.25"),
    Row("far start", "adaptive (default)", start="mono"),
    Row("far start", "the detector's pose and its sigmas", _pose_sigmas(0.05, 0.25, 0.06, 9.0), "mono"),
    *(Row("far start", name, Settings(overrides), "mono") for name, overrides in _SAMPLINGS.items()),
    *(Row("far start", name, Settings(overrides), "mono") for name, overrides in _STEPS.items()),
    Row("far start", "rays marched at every state", Settings(_RAYS["marched at every state"]), "mono"),
    Row("far start", "silhouette only", Settings(("photometric.weight=0",)), "mono"),
    Row("far start", "photometric only", Settings(("silhouette.weight=0",)), "mono"),
    *(Row("far start", f"start states: {name}", Settings(overrides), "mono") for name, overrides in _SEARCHES.items()),
    Row("far start", "fine stage only", Settings((f"stages=[{_FINE_POSE.replace('pose', 'both')}]",)), "mono"),
)
