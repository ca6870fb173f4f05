"""Damaged files of every format are read, or refused by an error of the package that names the file."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from file_damage import damaged
from file_samples import Sample, samples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from directshape_torch.errors import DirectShapeError, ResumeError

FORMATS = (
    "tracking", "shapes", "disparity", "rigs", "split",
    "scan", "network", "prior", "times", "poses", "mesh obj", "mesh ply", "mesh glb", "mesh off", "mesh stl",
    "settings", "coco", "instances", "image", "calibration", "plane", "labels", "detections", "masks", "rig",
    "frame", "raw calibration", "sequence calibration", "summary", "results", "report", "status", "timings",
    "results of a frame",
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(shared_kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Sample]:
    found = samples(shared_kitti, tmp_path_factory.mktemp("files"))
    assert set(found) == set(FORMATS)
    return found


# More of them, and what they cost: scripts/fuzz.py.
@pytest.mark.parametrize("tries", [4, pytest.param(100, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files(whole: dict[str, Sample], name: str, tries: int) -> None:
    sample = whole[name]
    errors: list[DirectShapeError] = []
    content = sample.path.read_bytes()
    sample.read()

    @given(chance=st.randoms(use_true_random=False))
    @settings(max_examples=tries, suppress_health_check=list(HealthCheck))
    def read(chance: random.Random) -> None:
        sample.path.write_bytes(damaged(content, sample.path.name, chance))
        try:
            sample.read()
        except DirectShapeError as error:
            errors.append(error)
        finally:
            sample.path.write_bytes(content)

    read()
    for error in errors:
        # In a whole folder another file, or the prior, may not fit the damaged one.
        of_others = "/out/" in str(error) or "the prior of the run" in str(error) or isinstance(error, ResumeError)
        assert sample.path.stem in str(error) or of_others
        assert len(str(error)) < 2500
    assert errors or not sample.is_exact
