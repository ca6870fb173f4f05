"""This package makes start boxes of cars from instance masks and stereo disparity, without a detector."""
