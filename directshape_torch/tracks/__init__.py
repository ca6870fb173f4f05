"""This package refines the views of a tracked car together: they have one shape, follow a path and see each other."""
