"""Fitting the residual disparity of a stereo rig to frames with known depth."""
