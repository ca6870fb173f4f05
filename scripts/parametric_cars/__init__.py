"""This package makes the parametric passenger cars of the bundled priors and the demo scene, without meshes."""
