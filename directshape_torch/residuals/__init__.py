"""The residuals of the energy, each with its Jacobian, and robust norms."""
