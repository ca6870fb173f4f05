"""The shape prior that a run's codes belong to."""

from __future__ import annotations

from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.errors import InputError
from directshape_torch.io.run_manifest import RunManifest
from directshape_torch.shape.load_prior import BUNDLED_PRIORS, load_prior
from directshape_torch.shape.shape_prior import ShapePrior


def prior_of_run(manifest: RunManifest, source: str | None) -> ShapePrior | None:
    """The named prior, or else that bundled one which the run used, or None where it used another.

    Raises:
        DataFormatError: a file that is no prior.
        InputError: the named prior is not that of the run.
    """
    wanted = manifest.sha256.get("prior")
    if source is not None:
        prior = load_prior(source)
        if wanted is not None and hash_prior(prior) != wanted:
            raise InputError("--prior", f"the prior of the run (sha256 {wanted[:12]})", f"another one, {source}")
        return prior
    return next((prior for prior in map(load_prior, BUNDLED_PRIORS) if hash_prior(prior) == wanted), None)
