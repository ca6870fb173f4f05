"""This package compares every derivative of the energy three ways, in named regimes, with counted exclusions."""
