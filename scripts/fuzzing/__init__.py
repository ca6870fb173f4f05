"""This package counts outcomes of odd calls, damaged files, and killed and faulty runs (`scripts/fuzz.py`)."""
