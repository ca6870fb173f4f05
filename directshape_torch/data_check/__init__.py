"""What is wrong with a stereo data set on disk: its files, their times, and the scenes in them."""
