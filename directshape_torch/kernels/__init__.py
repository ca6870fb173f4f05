"""Native loops, compiled by Numba, that take the place of chains of tensor operations on a CPU."""
