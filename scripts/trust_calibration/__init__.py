"""Parts of `scripts/calibrate_trust.py`."""
