"""A run resumes only into results of the same settings and contents, and names the difference."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior

from directshape_torch.errors import DataFormatError, ResumeError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.run_manifest import (
    RunManifest,
    check_resume,
    hash_fields,
    hash_prior,
    hash_tensors,
    read_manifest,
    write_manifest,
)
from directshape_torch.shape.pca_prior import PCAShapePrior

A, B = "a" * 64, "b" * 64


def manifest() -> RunManifest:
    return RunManifest(
        package_version="0.1.0",
        config={"solver": {"iterations": 20, "damping": 0.01}, "classes": ("Car",)},
        sha256={"prior": A, "stereo_bias": None},
        frames=["000001", "000002"],
    )


def test_round_trip_resumes(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    assert read_manifest(path) is None
    write_manifest(path, manifest())
    previous = read_manifest(path)
    check_resume(previous, manifest())
    assert previous.frames == ["000001", "000002"]
    assert previous.hash == manifest().hash != dataclasses.replace(manifest(), package_version="0.2.0").hash


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"package_version": "0.2.0"}, "package version was '0.1.0', now is '0.2.0'"),
        (
            {"config": {"solver": {"iterations": 30, "damping": 0.01}, "classes": ("Car",)}},
            r"cannot resume: setting 'solver\.iterations' was 20, now is 30; choose another output folder",
        ),
        (
            {"config": {"solver": {"iterations": 20}, "classes": ("Car",)}},
            r"setting 'solver\.damping' was 0\.01, now is 'absent'",
        ),
        ({"config": {**manifest().config, "new": 1}}, "setting 'new' was 'absent', now is 1"),
        ({"config": {**manifest().config, "classes": ["Car", "Van"]}}, r"setting 'classes' was \['Car'\], now is"),
        ({"sha256": {"prior": B, "stereo_bias": None}}, "sha256 of 'prior' was aaaaaaaaaaaa, now is bbbbbbbbbbbb"),
        ({"sha256": {"prior": A, "stereo_bias": B}}, "sha256 of 'stereo_bias' was None, now is bbbb"),
    ],
)
def test_differences_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ResumeError, match=message):
        check_resume(manifest(), dataclasses.replace(manifest(), **changes))  # type: ignore[arg-type]


def test_schema_and_damage(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    write_manifest(path, manifest())
    path.write_text(path.read_text().replace('"schema_version": 3', '"schema_version": 9'))
    with pytest.raises(ResumeError, match="schema version is 9, this program writes 3"):
        read_manifest(path)
    path.write_text('{"schema_version": [[]]}')
    with pytest.raises(ResumeError, match=r"schema version is \[\[\]\], this program writes 3"):
        read_manifest(path)
    for content in ("{", "7", "[]", "{}", '{"schema_version": 3, "x": 2}'):
        path.write_text(content)
        with pytest.raises(DataFormatError, match=r"summary\.json: .*(no summary|valid JSON|'x' is unknown)"):
            read_manifest(path)


@pytest.mark.parametrize("hashes", [{"stereo_bias": None}, {"prior": A}, {"prior": None, "stereo_bias": None}, {}])
def test_what_all_frames_share_is_needed(tmp_path: Path, hashes: dict[str, str | None]) -> None:
    path = tmp_path / "summary.json"
    write_manifest(path, manifest())
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sha256": hashes}))
    with pytest.raises(DataFormatError, match=r"summary\.json: sha256.*expected (an object with 'prior'|str)"):
        read_manifest(path)


def test_a_prior_has_the_same_hash_however_it_is_stored(tmp_path: Path) -> None:
    prior = ellipsoid_prior(torch.float32)
    prior.save(tmp_path / "first.npz")
    prior.save(tmp_path / "second_name.safetensors")
    hashes = {hash_prior(PCAShapePrior.load(path)) for path in tmp_path.iterdir()}
    assert hashes == {hash_prior(prior)}
    prior.basis[0, 0, 0, 0] += 1e-3
    assert hash_prior(prior) not in hashes


def test_names_and_shapes_of_tensors_count() -> None:
    tensor = torch.arange(6.0)
    same = [{"a": tensor}, {"b": tensor}, {"a": tensor.reshape(2, 3)}, {"a": tensor, "b": tensor}]
    assert len({hash_tensors(tensors) for tensors in same}) == 4


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
    changed = [hash_fields([dataclasses.replace(field, **{name: getattr(field, name) + 1})]) for name in names]
    changed += [
        hash_fields([field]),
        hash_fields([dataclasses.replace(field, size_wh=(48, 64))]),
        hash_fields([field, field]),
    ]
    assert len(set(changed)) == len(names) + 3
