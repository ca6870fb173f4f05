"""This package finds mistakes in stereo data, in tensors or files, and says what would explain them."""
