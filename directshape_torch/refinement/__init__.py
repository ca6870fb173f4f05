"""This package states the problem of the cars of a call, minimises it and judges the result."""
