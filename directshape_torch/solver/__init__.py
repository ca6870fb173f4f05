"""The damped Gauss-Newton loop over a batch of independent problems."""
