"""This package estimates from all evidence what is known of a stereo rig and of the detector that uses it."""
