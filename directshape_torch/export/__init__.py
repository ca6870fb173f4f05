"""This package exports a finished run in the formats of other programs."""
