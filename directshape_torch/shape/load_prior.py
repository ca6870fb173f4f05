"""This module loads shape priors by name or from a file, which says of which kind its prior is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.numerics.checks import check_type
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import read_description
from directshape_torch.shape.shape_prior import ShapePrior

BUNDLED_PRIORS: Mapping[str, Callable[[], ShapePrior]] = {
    "pca": PCAShapePrior.load_bundled,
    "neural": NeuralShapePrior.load_bundled,
}
"""This maps the names that `load_prior` knows to functions that load the priors of the package."""

_READERS: Mapping[str, Callable[[Path], ShapePrior]] = {
    PCAShapePrior.SCHEMA: PCAShapePrior.load,
    NeuralShapePrior.SCHEMA: NeuralShapePrior.load,
}


def load_prior(source: Path | str) -> ShapePrior:
    """A prior of any kind, float32 on the CPU.

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
    return reader(path)
