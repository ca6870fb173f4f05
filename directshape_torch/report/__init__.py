"""One self-contained HTML page about a run: tables, distributions, pictures, residual maps and 3D views."""
