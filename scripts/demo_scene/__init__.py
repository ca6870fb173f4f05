"""This package draws a seeded street scene, renders it, and writes its ground truth in KITTI's layout."""
