"""Hashes tell contents apart and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from helpers.ellipsoids import ellipsoid_prior

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.run_manifest import hash_fields, hash_prior, hash_tensors
from directshape_torch.shape.pca_prior import PCAShapePrior


def test_name_shape_and_values_count() -> None:
    tensor = torch.arange(6.0)
    hashes = [
        hash_tensors({"a": tensor}),
        hash_tensors({"b": tensor}),
        hash_tensors({"a": tensor.reshape(2, 3)}),
        hash_tensors({"a": tensor + 1e-6}),
        hash_tensors({"a": tensor, "b": tensor}),
    ]
    assert len(set(hashes)) == len(hashes)
    assert hash_tensors({"a": tensor, "b": tensor}) == hash_tensors({"b": tensor, "a": tensor})


def test_a_prior_has_the_same_hash_however_it_is_stored(tmp_path: Path) -> None:
    prior = ellipsoid_prior(torch.float32)
    prior.save(tmp_path / "first.npz")
    prior.save(tmp_path / "second_name.npz", grid_dtype="float64")
    hashes = {hash_prior(PCAShapePrior.load(path)) for path in tmp_path.iterdir()}
    assert hashes == {hash_prior(prior)}
    prior.basis[0, 0, 0, 0] += 1e-3
    assert hash_prior(prior) not in hashes


def test_every_tensor_of_a_field_counts() -> None:
    assert hash_fields(()) is None
    field = DisparityField(
        coefficients=torch.zeros(10),
        hull_uv=torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]),
        size_wh=(64, 48),
        K_left=torch.eye(3),
        K_right=torch.eye(3),
        T_right_cam=torch.eye(4),
    )
    names = [name for name, value in vars(field).items() if isinstance(value, torch.Tensor)]
    assert {"coefficients", "hull_uv", "K_left", "K_right", "T_right_cam"} <= set(names)
    changed = [hash_fields([replace(field, **{name: getattr(field, name) + 1})]) for name in names]
    changed += [hash_fields([field]), hash_fields([replace(field, size_wh=(48, 64))]), hash_fields([field, field])]
    assert len(set(changed)) == len(names) + 3
    assert hash_fields([replace(field, provenance={"made": "later"})]) == hash_fields([field])
