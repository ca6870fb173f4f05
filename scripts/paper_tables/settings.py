"""How one row of a table is refined: everything a reader can change, as data."""

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
