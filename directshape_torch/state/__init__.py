"""The state of cars: what is unknown of them, in which order, and what is known beforehand."""
