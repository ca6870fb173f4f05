"""Image operations: grey levels, gradients, pyramid, bilinear lookup."""
