"""Mutants of the hand-derived Jacobians: how they are made, which tests must catch them, how they are run."""
