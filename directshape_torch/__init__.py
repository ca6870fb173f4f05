"""Joint 3D pose and shape refinement of cars from stereo images (DirectShape), in PyTorch."""
