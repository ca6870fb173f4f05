"""Shape priors by the names that rows give them."""

from __future__ import annotations

from pathlib import Path

import torch
from judge_prior import ordinary_cars, true_sdf

from directshape_torch.errors import InputError
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.mesh_to_sdf import GridSpec
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance
from directshape_torch.shape.shape_prior import ShapePrior

# Models that are also among the rendered cars: a prior that knows them would be judged on its own training set.
RENDERED_TOO = ("gazebo/", "pgdrive/datsun130")
NUM_CODES_OF_MESHES = 5


def prior_for(name: str, meshes: Path | None, cache: Path) -> ShapePrior:
    """The prior of a row.

    Args:
        name: as in `Settings.prior`.
        meshes: folder of real car meshes, for "meshes".
        cache: folder to keep what was built.

    Raises:
        InputError: "meshes" without a folder of them.
        DataFormatError: a file that is no prior.
    """
    if name == "meshes":
        return _of_meshes(meshes, cache / "real_meshes.npz")
    kind, _, num_codes = name.partition(":")
    prior = load_prior(kind)
    if not num_codes:
        return prior
    if not isinstance(prior, PCAShapePrior):
        raise InputError("prior", "a number of components of a PCA prior, such as pca:5", name)
    return prior.with_num_codes(int(num_codes))


def _of_meshes(meshes: Path | None, path: Path) -> ShapePrior:
    if path.is_file():
        return PCAShapePrior.load(path)
    if meshes is None:
        raise InputError("prior", "a folder of car meshes beside the data sets", "none")
    files = {name: file for name, file in ordinary_cars(meshes).items() if not name.startswith(RENDERED_TOO)}
    grid = GridSpec.for_cars(0.1)
    samples = torch.stack([torch.from_numpy(true_sdf(file, grid)) for file in files.values()])
    made = PriorProvenance("scripts/reproduce_tables.py", "as the meshes", len(files), ", ".join(files))
    prior = PCAShapePrior.fit(samples, torch.tensor(grid.origin), grid.spacing_m, NUM_CODES_OF_MESHES, made)
    path.parent.mkdir(parents=True, exist_ok=True)
    prior.save(path)
    # As read from the file, so that a second run has the same hash.
    return PCAShapePrior.load(path)
