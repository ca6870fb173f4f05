"""What is wrong with a stereo data set, measured: pair, calibration, masks, boxes, distances, times."""
