"""The table of rotations and units is right for one car."""

from __future__ import annotations

import sys
from pathlib import Path

import mesh_turns as script
import numpy as np
import pytest
import trimesh
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_mesh


def test_all_turns_of_a_car_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = car_mesh(sample_car(3, "hatchback"), spacing_m=0.1)
    upright = np.asarray(mesh.vertices)[:, [0, 2, 1]] * [1, 1, -1]
    trimesh.Trimesh(upright, mesh.faces, process=False).export(tmp_path / "car.ply")
    monkeypatch.setattr(script, "UNITS", {name: script.UNITS[name] for name in ("metres", "unit size")})
    monkeypatch.setattr(sys, "argv", ["turns", "--meshes", str(tmp_path)])
    script.main()
    assert capsys.readouterr().out.splitlines() == [
        "metres: 23 refused, named right, 1 passed, right",
        "unit size: 24 refused, named right",
    ]
