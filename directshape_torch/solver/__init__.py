"""This package has the damped Gauss-Newton loop over a batch of problems."""
