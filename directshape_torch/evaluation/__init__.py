"""Comparing refined with rough detections: matching to labels, errors, overlaps and their confidence."""
