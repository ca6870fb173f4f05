"""This package has parts of `scripts/calibrate_trust.py`."""
