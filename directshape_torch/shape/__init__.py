"""Shapes of cars as signed distance fields: grids, the PCA prior, ray casting, meshes and how priors are made."""
