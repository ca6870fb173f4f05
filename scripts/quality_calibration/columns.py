"""The columns of evidence that the models read."""

from __future__ import annotations

# Chosen by forward selection on the cross-validated log loss of the development cars, then fixed.
BETTER = (
    "relative_decrease",
    "log_silhouette_cost",
    "log_moved_sigmas",
    "log_depth",
    "photometric_decrease",
)
NOT_WORSE = (
    "relative_decrease",
    "turned",
    "log_sigma_depth",
    "log_silhouette_cost",
    "log_depth",
    "log_sigma_yaw",
)
