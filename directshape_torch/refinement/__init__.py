"""The refinement of the cars of a call: their problem, cars by themselves and in tracks, and what comes out."""
