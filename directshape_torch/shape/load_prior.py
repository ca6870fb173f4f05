"""Shape priors of any kind from a file or by name: the file itself says of which kind it is."""

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
"""The priors that come with the package, by the name that `load_prior` knows them by."""

_READERS: Mapping[str, Callable[[Path], ShapePrior]] = {
    PCAShapePrior.SCHEMA: PCAShapePrior.load,
    NeuralShapePrior.SCHEMA: NeuralShapePrior.load,
}


def load_prior(source: Path | str) -> ShapePrior:
    """A prior of any kind, float32 on the CPU.

    Args:
        source: "pca" or "neural" for a bundled one ("./neural" is a file), else a file of some prior's `save`.

    Raises:
        DataFormatError: no such file, or not a whole file of any kind that is known.

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
