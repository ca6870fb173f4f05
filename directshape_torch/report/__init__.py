"""This package writes one HTML page about a run: tables, distributions, pictures, residual maps and 3D views."""
