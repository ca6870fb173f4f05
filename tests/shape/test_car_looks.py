"""Meshes with wrong axes, units or parts are refused with the options that they need, and right ones pass."""

from __future__ import annotations

import json
import os
from functools import cache
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from parametric_cars.measures import BODY_TYPES, sample_car
from parametric_cars.surfaces import car_mesh
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from directshape_torch.errors import DataFormatError, MeshError, PriorWarning, UnlikelyMeshError
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf, place_mesh
from directshape_torch.shape.outlines import AXES
from directshape_torch.shape.pca_prior import PCAShapePrior

TURNS = [(forward, up) for forward, up in permutations(AXES, 2) if AXES[forward] != AXES[up]]
Array = NDArray[np.float64]


def vector(axis: str) -> Array:
    return np.eye(3)[AXES[axis]] * (1.0 if axis[0] == "+" else -1.0)


@cache
def body(body_type: str) -> trimesh.Trimesh:
    return car_mesh(sample_car(3, body_type), spacing_m=0.1)


def car(body_type: str = "saloon") -> trimesh.Trimesh:
    """A car with its front towards +x and its roof towards +z, metres."""
    mesh = body(body_type)
    return trimesh.Trimesh(np.asarray(mesh.vertices)[:, [0, 2, 1]] * [1, 1, -1], mesh.faces, process=False)


def turned(mesh: trimesh.Trimesh, forward: str, up: str) -> trimesh.Trimesh:
    """The mesh with its front and roof towards other axes."""
    left = np.cross(vector(up), vector(forward))
    vertices = np.asarray(mesh.vertices) @ np.stack([vector(forward), left, vector(up)])
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def saved(mesh: trimesh.Trimesh, folder: Path, suffix: str = "ply") -> Path:
    path = folder / f"car.{suffix}"
    mesh.export(path)
    return path


def needs(mesh: trimesh.Trimesh, folder: Path, options: MeshOptions | None = None) -> dict[str, str | float]:
    """The options that the refusal of a mesh names."""
    with pytest.raises(UnlikelyMeshError) as refused:
        load_mesh_obj(saved(mesh, folder), options)
    return refused.value.cure


OTHERS = [pytest.param(name, marks=pytest.mark.long) for name in BODY_TYPES if name not in ("saloon", "pickup")]


@pytest.mark.parametrize("body_type", ["saloon", *OTHERS])
def test_every_turn_but_the_right_one_is_refused_with_the_right_one(body_type: str, tmp_path: Path) -> None:
    mesh = car(body_type)
    load_mesh_obj(saved(mesh, tmp_path))
    for forward, up in TURNS:
        if (forward, up) != ("+x", "+z"):
            cure = needs(turned(mesh, forward, up), tmp_path)
            assert cure == {"forward_axis": forward, "up_axis": up}


def test_what_is_named_makes_the_mesh_pass(tmp_path: Path) -> None:
    path = saved(turned(car(), "-y", "+x").apply_scale(1000), tmp_path)
    with pytest.raises(UnlikelyMeshError, match=r"car\.ply: .* in millimetres; it needs MeshOptions\(") as refused:
        load_mesh_obj(path)
    placed = load_mesh_obj(path, MeshOptions(**refused.value.cure))  # type: ignore[arg-type]
    np.testing.assert_allclose(placed.extents[[0, 2, 1]], car().extents, rtol=1e-5)


def test_meshes_in_memory_are_checked_as_well() -> None:
    mesh, options = turned(car(), "+z", "+y"), MeshOptions(forward_axis="+z", up_axis="+y", voxel_m=0.1)
    with pytest.raises(UnlikelyMeshError, match=r"mesh: .* standing on its front or rear; it needs"):
        place_mesh(mesh, MeshOptions())
    grid, before = GridSpec.for_cars(0.2), np.array(mesh.vertices)
    mesh_to_sdf(place_mesh(mesh, options), grid, options)
    np.testing.assert_array_equal(mesh.vertices, before)
    with pytest.raises(
        UnlikelyMeshError, match=r"tall: .*object frame \(x forward, y down, metres\) by place_mesh; it nee"
    ):
        mesh_to_sdf(mesh, grid, options, "tall")


@pytest.mark.parametrize(
    ("forward", "up", "looks"),
    [
        ("-x", "+z", "driving backwards"),
        ("+x", "-z", "upside down"),
        ("+y", "+z", "turned by 90 degrees about the vertical"),
        ("+x", "+y", "lying on its side"),
        ("+z", "+x", "standing on its front or rear"),
    ],
)
def test_it_is_said_what_the_mesh_looks_like(forward: str, up: str, looks: str, tmp_path: Path) -> None:
    with pytest.raises(UnlikelyMeshError, match=f"it looks like a car {looks}; it needs"):
        load_mesh_obj(saved(turned(car(), forward, up), tmp_path))


@pytest.mark.parametrize(("factor", "scale"), [(1000, 0.001), (100, 0.01), (1 / 0.0254, 0.0254), (0.001, 1000.0)])
def test_units_are_named(factor: float, scale: float, tmp_path: Path) -> None:
    for body_type in ("city", "pickup"):  # the shortest and the longest
        assert needs(car(body_type).apply_scale(factor), tmp_path) == {"scale": scale}
        assert needs(car(body_type), tmp_path, MeshOptions(scale=factor)) == {"scale": 1.0}


def test_a_mesh_of_unit_size_needs_a_length(tmp_path: Path) -> None:
    unit = car().apply_scale(1 / car().extents.max())
    assert needs(unit, tmp_path) == {"length_m": 4.2}
    load_mesh_obj(saved(unit, tmp_path), MeshOptions(length_m=4.2))
    assert needs(unit, tmp_path, MeshOptions(length_m=420.0)) == {"length_m": 4.2}


def test_parts_of_a_car_and_other_things_are_none(tmp_path: Path) -> None:
    half = car()
    half.update_faces(half.triangles_center[:, 1] > 0)
    with pytest.raises(UnlikelyMeshError, match="looks like half a car, cut along its middle") as refused:
        load_mesh_obj(saved(half, tmp_path))
    assert not refused.value.cure
    front = car()
    front.update_faces(front.triangles_center[:, 0] > 0)
    on_a_plate = trimesh.util.concatenate([car(), trimesh.creation.box((8, 5, 0.01))])
    askew = car().apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(20), [0, 0, 1]))
    bus, person = trimesh.creation.box((12, 2.5, 3.2)), trimesh.creation.cylinder(0.3, 1.8)
    for mesh in (front, person):
        with pytest.raises(UnlikelyMeshError, match=r", or MeshOptions\(are_cars=False\) if it is of another class"):
            load_mesh_obj(saved(mesh, tmp_path))
        load_mesh_obj(saved(mesh, tmp_path), MeshOptions(are_cars=False))
    for mesh in (on_a_plate, askew, bus):
        with pytest.raises(UnlikelyMeshError, match=r"car in no turn, .*MeshOptions\(are_cars=False\) if it is of ano"):
            load_mesh_obj(saved(mesh, tmp_path))
        load_mesh_obj(saved(mesh, tmp_path), MeshOptions(are_cars=False))


def test_what_does_not_make_a_car_unlikely(tmp_path: Path) -> None:
    """Its mirror image, a place far away, open parts, a filled floor, a mirror at one side, a loose corner."""
    whole = car()
    mirrored, far, open_below = whole.copy(), whole.copy().apply_translation((1e4, -1e4, 50)), whole.copy()
    mirrored.vertices = np.asarray(whole.vertices) * [1, -1, 1]
    open_below.update_faces(whole.triangles_center[:, 2] > 0.25)
    length, width, _ = whole.extents
    floor = trimesh.creation.box((0.98 * length, 0.9 * width, 0.3)).apply_translation((0, 0, 0.15))
    bar = trimesh.creation.box((0.1, 0.25, 0.2)).apply_translation((0.8, 0.5 * width + 0.1, 0.9))
    for mesh in (mirrored, far, open_below, *(trimesh.util.concatenate([whole, part]) for part in (floor, bar))):
        load_mesh_obj(saved(mesh, tmp_path))
    loose = np.concatenate([whole.vertices, [[1e3, 0, 0]]])
    path = tmp_path / "loose.off"
    path.write_text(trimesh.Trimesh(loose, whole.faces, process=False).export(file_type="off"))
    np.testing.assert_allclose(load_mesh_obj(path).bounds, load_mesh_obj(saved(whole, tmp_path, "off")).bounds)


def test_corners_that_single_precision_rounds_are_refused(tmp_path: Path) -> None:
    far = car().apply_translation((5e5, 5.4e6, 0))
    load_mesh_obj(saved(far, tmp_path, "obj"))
    for are_cars in (True, False):
        with pytest.raises(MeshError, match=r"as far as 5\.4e\+06 .* steps of 0\.5; move the mesh to its origin"):
            load_mesh_obj(saved(far, tmp_path, "stl"), MeshOptions(are_cars=are_cars))


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.long)])
def test_real_cars_pass_and_their_turns_are_named(step: int) -> None:
    root = os.environ.get("DIRECTSHAPE_DATA")
    if root is None:
        pytest.skip("DIRECTSHAPE_DATA is not set: no real meshes at hand")
    files = [file for file in sorted((Path(root) / "meshes").rglob("*")) if file.suffix in (".obj", ".glb")]
    assert len(files) >= 21
    for file in files[::step]:
        right, wrong = MeshOptions(), MeshOptions(forward_axis="+z", up_axis="+y")
        if file.suffix == ".glb":
            right, wrong = wrong, right
        load_mesh_obj(file, right)
        with pytest.raises(UnlikelyMeshError) as refused:
            load_mesh_obj(file, wrong)
        assert refused.value.cure["up_axis"] == right.up_axis
        if "pickup" not in file.name:
            assert refused.value.cure["forward_axis"] == right.forward_axis


def changed(folder: Path, *axes: int, provenance: dict[str, object] | None = None) -> Path:
    """A file of the bundled prior whose grid is reversed along axes."""
    prior, path = PCAShapePrior.load_bundled(), folder / "prior.safetensors"
    prior.mean, prior.basis = prior.mean.flip(axes), prior.basis.flip(axes)
    if 1 in axes:
        # The ground stays at y = 0.
        prior.origin[1] = -(prior.origin[1] + prior.spacing_m * (prior.mean.shape[1] - 1)) - 1.5
    prior.save(path)
    if provenance is not None:
        description = json.loads(safe_open(path, "pt").metadata()["description"])
        description["provenance"].update(provenance)
        save_file(load_file(path), path, {"description": json.dumps(description)})
    return path


def test_files_of_priors_that_do_not_look_like_cars_warn(tmp_path: Path) -> None:
    load_prior(changed(tmp_path))
    for axes, looks in (((0,), "driving backwards"), ((1,), "upside down")):
        with pytest.warns(PriorWarning, match=f"mean shape: .* it looks like a car {looks}; build it anew"):
            load_prior(changed(tmp_path, *axes))
    load_prior(changed(tmp_path, 1, provenance={"of_cars": False}))
    prior = PCAShapePrior.load_bundled()
    prior.spacing_m /= 4
    prior.save(tmp_path / "small.safetensors")
    with pytest.warns(PriorWarning, match=r"small.safetensors, mean shape: 0\.9.* m long"):
        load_prior(tmp_path / "small.safetensors")
    with pytest.raises(DataFormatError, match="no shape prior"):
        load_prior(changed(tmp_path, provenance={"of_cars": "no"}))
