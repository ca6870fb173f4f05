"""The views of a tracked car, which have one shape, follow a path, and see each other: a room above the core."""
