"""This package checks a stereo data set on disk: its files, and the scenes in them."""
