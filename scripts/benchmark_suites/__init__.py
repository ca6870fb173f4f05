"""This package has the suites of `scripts/benchmark.py`."""
