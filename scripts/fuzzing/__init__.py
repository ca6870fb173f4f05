"""Odd calls, damaged files, killed and faulty runs in numbers (`scripts/fuzz.py`)."""
