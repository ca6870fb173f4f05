import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_mesh

from directshape_torch.cli import build_prior
from directshape_torch.cli.main import main
from directshape_torch.files.mesh_files import read_mesh
from directshape_torch.shape.pca_prior import PCAShapePrior


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cars in the object frame: front +x, up -y."""
    folder = tmp_path_factory.mktemp("meshes")
    for seed, suffix in enumerate(("obj", "ply", "off")):
        car_mesh(sample_car(seed), spacing_m=0.1).export(folder / f"car{seed}.{suffix}")
    return folder


OPTIONS = ("--up-axis=-y", "--num-codes", "1", "--spacing", "0.2", "--voxel", "0.08")


def test_writes_prior_and_report(meshes, tmp_path, capsys):
    out = tmp_path / "made" / "car.safetensors"
    assert main(["build-prior", "--meshes", str(meshes), "--out", str(out), *OPTIONS]) == 0
    prior = PCAShapePrior.load(out)
    assert prior.num_codes == 1
    assert prior.provenance.num_samples == 3
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["schema"] == build_prior.REPORT_SCHEMA
    assert report["meshes"] == ["car0.obj", "car1.ply", "car2.off"]
    assert 0 < report["leave_one_out_error_cm"] < 20
    lengths = [sample_car(seed).length for seed in range(3)]
    assert report["mean_height_width_length_m"][2] == pytest.approx(sum(lengths) / 3, abs=0.1)
    assert "leave-one-out error" in capsys.readouterr().out
    assert sorted(f.name for f in out.parent.iterdir()) == ["car.json", "car.safetensors"]


def test_two_cars_say_nothing_of_a_third(meshes, tmp_path, capsys):
    out = tmp_path / "car.safetensors"
    assert main(["build-prior", "--meshes", str(meshes), "--out", str(out), "--pattern", "car[01].*", *OPTIONS]) == 0
    assert json.loads(out.with_suffix(".json").read_text())["leave_one_out_error_cm"] is None
    assert "leave-one-out error within 7 cm of the surface: not known, of two cars" in capsys.readouterr().out


def turned(meshes: Path, folder: Path, axes: Sequence[int], scale: float, suffixes: str = ".obj .ply .off") -> Path:
    """The meshes with exchanged axes and another unit."""
    folder.mkdir(exist_ok=True)
    for file in meshes.iterdir():
        if file.suffix in suffixes.split():
            vertices, faces = read_mesh(file)
            trimesh.Trimesh(scale * vertices[:, axes], faces, process=False).export(folder / f"{file.stem}.ply")
    return folder


def test_a_folder_with_wrong_axes_and_unit_names_the_options_that_work(meshes, tmp_path, capsys):
    # The fixture's x forward, y down, z to the left become y down, z to the left, x forward: a reflection as well.
    folder, out = turned(meshes, tmp_path / "turned", (1, 2, 0), 1000.0), tmp_path / "car.safetensors"
    words = ("build-prior", "--meshes", str(folder), "--out", str(out))
    few = ("--num-codes", "1", "--spacing", "0.2", "--voxel", "0.08")
    assert main([*words, *few]) == 2
    said = capsys.readouterr().err
    assert "got 0 (3 skipped, the first: " in said
    assert "car0.ply: 1" in said
    cure = "--forward-axis=+z --up-axis=-x --scale=0.001"
    assert f"in millimetres; it needs {cure}, or --not-cars" in said
    assert said.rstrip().endswith(f"; 3 of them look like cars with {cure}")
    assert not out.exists()
    assert main([*words, *few, *cure.split()]) == 0
    assert PCAShapePrior.load(out).provenance.of_cars


def test_wrong_meshes_among_good_ones_are_left_out_by_name(meshes, tmp_path, capsys):
    folder = turned(meshes, tmp_path / "mixed", (0, 1, 2), 1.0, ".obj .ply")
    turned(meshes, folder, (1, 2, 0), 1.0, ".off")
    (folder / "broken.obj").write_text("v 0 0 0\n")
    out = tmp_path / "car.safetensors"
    assert main(["build-prior", "--meshes", str(folder), "--out", str(out), *OPTIONS]) == 3
    said = capsys.readouterr().out
    assert "skipped car2.ply: " in said
    assert "it looks like a car lying on its side; it needs --forward-axis=+z --up-axis=-x" in said
    assert said.rstrip().endswith("bring all meshes to the same axes and unit first (docs/bring_your_own_shapes.md)")
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["meshes"] == ["car0.ply", "car1.ply"]
    assert list(report["skipped"]) == ["broken.obj", "car2.ply"]


def test_meshes_of_another_class_get_a_grid_of_their_size(tmp_path, capsys):
    for name, size in (("a", (12.0, 2.5, 3.2)), ("b", (11.0, 2.5, 3.0)), ("c", (10.5, 2.4, 3.1))):
        trimesh.creation.box(size).export(tmp_path / f"{name}.obj")
    out = tmp_path / "bus.safetensors"
    words = ("--meshes", str(tmp_path), "--out", str(out), "--num-codes", "1", "--spacing", "0.3", "--voxel", "0.1")
    assert main(["build-prior", *words]) == 2
    assert "--not-cars if it is of another class" in capsys.readouterr().err
    assert main(["build-prior", *words, "--not-cars"]) == 0
    prior = PCAShapePrior.load(out)
    assert not prior.provenance.of_cars
    assert prior.dimensions_mean_hwl.tolist() == pytest.approx([3.1, 2.47, 11.17], abs=0.15)
    assert main(["build-prior", *words, "--not-cars", "--scale", "100"]) == 2
    assert "--scale: expected meshes of at most 30 m, got none of 3" in capsys.readouterr().err


@pytest.mark.filterwarnings("always::directshape_torch.errors.PriorWarning")
def test_a_prior_that_is_no_car_is_warned_of_in_a_line(meshes, tmp_path, capsys):
    folder, out = turned(meshes, tmp_path / "small", (0, 1, 2), 0.5), tmp_path / "car.safetensors"
    assert main(["build-prior", "--meshes", str(folder), "--out", str(out), *OPTIONS, "--not-cars"]) == 0
    prior = PCAShapePrior.load(out)
    prior.provenance = replace(prior.provenance, of_cars=True)
    prior.save(out)
    assert main(["inspect", "--demo", "--prior", str(out), "--car", "99", "--out", str(tmp_path / "drawn")]) == 2
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: "))
    assert f"{out}, mean shape: " in warning
    assert "it looks like a car of the length" in warning
