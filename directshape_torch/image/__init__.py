"""This package holds image operations: grey levels, gradients, pyramid, bilinear lookup."""
