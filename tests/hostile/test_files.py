"""Damaged files of every format are refused by an error of ours that names the file, or read."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest
from hostile_files import Sample, damaged, samples

from directshape_torch.errors import DirectShapeError, ResumeError

FORMATS = (
    "times", "tracking", "tracks", "shapes", "disparity", "field", "network", "prior", "trust", "settings", "image",
    "calibration", "plane", "labels", "detections", "masks", "rig", "frame", "summary", "report", "results", "run",
)  # fmt: skip
# More of them: DIRECTSHAPE_FUZZ=600 pytest tests/hostile
TRIES = int(os.environ.get("DIRECTSHAPE_FUZZ", "25"))


@pytest.fixture(scope="module")
def whole(shared_kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Sample]:
    return samples(shared_kitti, tmp_path_factory.mktemp("files"))


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files(whole: dict[str, Sample], name: str) -> None:
    sample, chance = whole[name], random.Random(name)
    content = sample.path.read_bytes()
    errors: list[DirectShapeError] = []
    try:
        sample.read()
        for _ in range(TRIES):
            sample.path.write_bytes(damaged(content, sample.path.name, chance))
            try:
                sample.read()
            except DirectShapeError as error:
                errors.append(error)
    finally:
        sample.path.write_bytes(content)
    for error in errors:
        # Of a whole folder it may be a file that does not fit the damaged one.
        assert sample.path.stem in str(error) or "/out/" in str(error) or isinstance(error, ResumeError)
        assert len(str(error)) < 2500
    assert len(errors) > TRIES // 5
    assert set(whole) == set(FORMATS)
