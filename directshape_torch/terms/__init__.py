"""This package holds the summands of the energy, with their residuals, Jacobians and norms."""
