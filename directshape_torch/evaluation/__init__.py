"""Results against labels: KITTI's scores, what a refinement changed, matching, errors, overlaps, confidence."""
