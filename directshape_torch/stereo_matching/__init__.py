"""Dense disparity from image pairs, and points and ground planes from it."""
