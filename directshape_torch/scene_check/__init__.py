"""This package finds mistakes in a stereo scene from its images, calibration, masks and boxes."""
