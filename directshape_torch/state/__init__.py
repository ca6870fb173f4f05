"""This package defines the state of cars: their unknowns, the order of these, and what is known beforehand."""
