"""The columns of evidence that the models read."""

from __future__ import annotations

# Found by forward selection on the cross-validated log loss of the development cars; of columns that say the same one
# is kept, and none whose weight would have the wrong sign for what it means.
BETTER = (
    "relative_decrease",
    "log_detector_sigma",
    "turned",
    "log_expected_gain",
    "log_sigma_yaw",
    "log_profile_contrast",
    "mask_misfit_left",
)
NOT_WORSE = (
    "relative_decrease",
    "turned",
    "log_sigma_yaw",
    "mask_misfit_left",
    "log_profile_fall_before",
)
