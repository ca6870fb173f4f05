"""This package holds what a refinement is given: frames, masks and detections."""
