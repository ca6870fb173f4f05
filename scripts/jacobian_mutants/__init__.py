"""This package makes mutants of the hand-derived Jacobians, names the tests that must catch them, and runs these."""
