"""Pictures of results, pixels, shape priors and disparity fields."""
