"""This package holds rigid motions, cameras, boxes, planes and the residual disparity of a rig."""
