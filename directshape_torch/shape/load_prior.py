"""This module loads shape priors by name or from a file, which says of which kind its prior is."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

import torch
from torch.nn import functional

from directshape_torch.errors import DataFormatError, PriorWarning, UnlikelyMeshError, shown
from directshape_torch.numerics.checks import check_type
from directshape_torch.shape.car_looks import check_looks
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.outlines import Outlines
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import read_description
from directshape_torch.shape.shape_prior import ShapePrior

BUNDLED_PRIORS: Mapping[str, Callable[[], ShapePrior]] = {
    "pca": PCAShapePrior.load_bundled,
    "neural": NeuralShapePrior.load_bundled,
}
"""This maps the names that `load_prior` knows to functions that load the priors of the package."""

_READERS: Mapping[str, Callable[[Path], PCAShapePrior | NeuralShapePrior]] = {
    PCAShapePrior.SCHEMA: PCAShapePrior.load,
    NeuralShapePrior.SCHEMA: NeuralShapePrior.load,
}
# Cells of this size show the road between the wheels.
_FINE_M = 0.05


def load_prior(source: Path | str) -> ShapePrior:
    """A prior of any kind, float32 on the CPU.

    A `PriorWarning` is given where a file says that it holds cars and its mean shape does not look like one.

    Args:
        source: "pca" or "neural" for a bundled prior ("./neural" is a file), else a file that a prior's `save` wrote.

    Raises:
        DataFormatError: the file is missing, incomplete or of an unknown kind.

    Examples:
        >>> load_prior("pca").num_codes == load_prior("neural").num_codes
        True
    """
    check_type("source", source, (str, PathLike))
    bundled = BUNDLED_PRIORS.get(str(source)) if isinstance(source, str) else None
    if bundled is not None:
        return bundled()
    path = Path(source)
    cure = f"make one with: directshape build-prior; bundled ones are {' and '.join(BUNDLED_PRIORS)}"
    schema = read_description(path, cure).get("schema", "none")
    reader = _READERS.get(schema) if isinstance(schema, str) else None
    if reader is None:
        raise DataFormatError(path, f"schema {shown(schema)} is none of {', '.join(_READERS)}")
    prior = reader(path)
    if prior.provenance.of_cars:
        _warn_of_looks(path, prior)
    return prior


@torch.no_grad()
def _warn_of_looks(path: Path, prior: ShapePrior) -> None:
    """Warn where the mean shape does not look like a car with x forward and y down, in metres."""
    values, times = prior.values(prior.initial_code(1)), max(math.ceil(prior.spacing_m / _FINE_M - 1e-6), 1)
    if times > 1:
        nodes = [times * (count - 1) + 1 for count in values.shape[1:]]
        values = functional.interpolate(values[None], nodes, mode="trilinear", align_corners=True)[0]
    outlines = Outlines.of_solid((values[0] < 0).numpy(), prior.spacing_m / times)
    try:
        check_looks(outlines, "+x", "-y", name=f"{path}, mean shape")
    except UnlikelyMeshError as problem:
        cure = "build it anew, with --not-cars (PriorProvenance.of_cars) if it is of another class"
        warnings.warn(f"{problem.found}; {cure}", PriorWarning, stacklevel=4)
