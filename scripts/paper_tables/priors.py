"""Shape priors by the names that rows give them."""

from __future__ import annotations

from directshape_torch.errors import InputError
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior


def prior_for(name: str) -> ShapePrior:
    """The prior of a row, `name` as in `Settings.prior`.

    Raises:
        InputError: a number of components of a prior that is no PCA.
        DataFormatError: a file that is no prior.
    """
    kind, _, num_codes = name.partition(":")
    prior = load_prior(kind)
    if not num_codes:
        return prior
    if not isinstance(prior, PCAShapePrior):
        raise InputError("prior", "a number of components of a PCA prior, such as pca:5", name)
    return prior.with_num_codes(int(num_codes))
