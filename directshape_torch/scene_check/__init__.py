"""What is wrong with a stereo scene, measured from its images, calibration, masks and boxes."""
