"""The refinement of the cars of a call: their problem, by themselves and in tracks, and what is said of the end."""
