"""This package compares results with labels: KITTI's scores, changes by a refinement, matching, errors and IoU."""
