"""Parametric passenger cars, which the bundled priors and the demo scene are made of: no foreign mesh goes in."""
