"""This package computes every residual a second time, slowly and readably, ray by ray, as reference for the terms."""
