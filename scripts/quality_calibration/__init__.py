"""Parts of `scripts/calibrate_quality.py`."""
