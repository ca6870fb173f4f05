"""The columns of evidence that the models read."""

from __future__ import annotations

# Found by forward selection on the cross-validated log loss of the development cars; of columns that say the same one
# is kept, and none whose weight would have the wrong sign for what it means.
BETTER = (
    "photometric_decrease",
    "log_silhouette_cost",
    "log_moved_sigmas",
    "log_expected_gain",
    "turned",
    "log_depth",
)
NOT_WORSE = (
    "photometric_decrease",
    "log_silhouette_cost",
    "log_expected_misfit",
    "turned",
    "log_depth",
)
