"""The course of one car's refinement in figures, as in the paper, and a shape prior in figures."""
