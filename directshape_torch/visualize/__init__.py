"""This package draws pictures of results, pixels, shape priors and disparity fields."""
