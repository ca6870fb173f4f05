"""What is known of a stereo rig and of the detector behind it, from every kind of evidence."""
