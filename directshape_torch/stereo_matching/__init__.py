"""This package finds dense disparity of image pairs, and points and ground planes from the disparity."""
