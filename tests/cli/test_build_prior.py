import json
from pathlib import Path

import pytest
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_mesh

from directshape_torch.cli import build_prior
from directshape_torch.cli.main import make_parser
from directshape_torch.shape.pca_prior import PCAShapePrior


def run(*arguments: str) -> int:
    args = make_parser().parse_args(["build-prior", *arguments])
    code: int = args.run(args)
    return code


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
    assert run("--meshes", str(meshes), "--out", str(out), *OPTIONS) == 0
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


def test_skips_a_mesh_that_is_no_solid_and_says_so(meshes, tmp_path, capsys):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for file in meshes.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "broken.obj").write_text("v 0 0 0\n")
    assert run("--meshes", str(folder), "--out", str(tmp_path / "car.safetensors"), *OPTIONS) == 3
    assert "skipped broken.obj" in capsys.readouterr().out


def test_two_cars_say_nothing_of_a_third(meshes, tmp_path, capsys):
    out = tmp_path / "car.safetensors"
    assert run("--meshes", str(meshes), "--out", str(out), "--pattern", "car[01].*", *OPTIONS) == 0
    assert json.loads(out.with_suffix(".json").read_text())["leave_one_out_error_cm"] is None
    assert "leave-one-out error within 7 cm of the surface: not known, of two cars" in capsys.readouterr().out
