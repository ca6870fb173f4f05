from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from directshape_torch.errors import DataFormatError, InputError, MeshError
from directshape_torch.geometry import se3
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.zero_level import sdf_to_mesh

X = torch.linspace(-1.2, 1.2, 25, dtype=torch.float64)
NODES = torch.stack(torch.meshgrid(X, X, X, indexing="ij"), dim=-1)
ORIGIN = X[0].expand(3)


def test_ball_lies_where_the_pose_puts_it_with_outward_normals():
    values = (NODES - torch.tensor([0.1, -0.2, 0.0], dtype=torch.float64)).norm(dim=-1) - 0.7
    T_cam_obj = se3.exp(torch.tensor([1.0, 2.0, 20.0, 0.1, 0.7, -0.2], dtype=torch.float64))
    mesh = sdf_to_mesh(values, ORIGIN, 0.1, T_cam_obj)
    centre = se3.transform(T_cam_obj, torch.tensor([0.1, -0.2, 0.0], dtype=torch.float64)).numpy()
    from_centre = mesh.triangles_center - centre
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - centre, axis=1), 0.7, atol=3e-3)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.02)  # the faces cut the corners of the ball
    area = mesh.area_faces > 1e-8
    assert ((mesh.face_normals * from_centre).sum(axis=1)[area] > 0).all()


def test_a_surface_that_leaves_the_grid_is_closed_at_the_border():
    slab = sdf_to_mesh(NODES[..., 1].abs() - 0.3, ORIGIN, 0.1)
    assert slab.is_watertight
    assert slab.volume > 0


def test_no_surface_and_wrong_shapes():
    with pytest.raises(MeshError, match="does not cross"):
        sdf_to_mesh(torch.ones(4, 4, 4), torch.zeros(3), 0.1)
    with pytest.raises(InputError, match="values: expected shape"):
        sdf_to_mesh(torch.ones(1, 4, 4, 4), torch.zeros(3), 0.1)
    with pytest.raises(InputError, match="T_cam_obj"):
        sdf_to_mesh(NODES.norm(dim=-1) - 0.7, ORIGIN, 0.1, torch.eye(3))


GRID = GridSpec.for_cars(0.2)
COARSE = MeshOptions(voxel_m=0.05, are_cars=False)
SIZE = np.array([4.0, 1.5, 1.8])


def box_on_the_ground() -> trimesh.Trimesh:
    return trimesh.creation.box(SIZE).apply_translation((0.0, -0.75, 0.0))


def box_sdf(points: np.ndarray) -> np.ndarray:
    q = np.abs(points - [0.0, -0.75, 0.0]) - 0.5 * SIZE
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def with_hole(side: float) -> trimesh.Trimesh:
    """The box with a square hole in its roof."""
    mesh = box_on_the_ground().subdivide_to_size(0.1)
    centre = mesh.triangles_center
    in_hole = (centre[:, 1] < -1.49) & (np.abs(centre[:, 0]) < side / 2) & (np.abs(centre[:, 2]) < side / 2)
    assert in_hole.any()
    mesh.update_faces(~in_hole)
    return mesh


def test_box_agrees_with_its_formula():
    sdf = mesh_to_sdf(box_on_the_ground(), GRID, COARSE)
    error = np.abs(sdf - box_sdf(GRID.nodes()))
    assert error.max() < 0.05
    assert error.mean() < 0.03


def test_small_hole_still_gets_solid():
    sdf = mesh_to_sdf(with_hole(0.2), GRID, COARSE)
    assert np.abs(sdf - box_sdf(GRID.nodes())).max() < 0.08


def test_missing_side_raises():
    mesh = box_on_the_ground()
    mesh.update_faces(mesh.triangles_center[:, 1] > -1.49)
    with pytest.raises(MeshError, match="half a box: cannot be made solid"):
        mesh_to_sdf(mesh, GRID, COARSE, name="half a box")


def test_symmetry_is_exact_and_can_be_switched_off():
    one_sided = trimesh.util.concatenate(
        [box_on_the_ground(), trimesh.creation.box((0.6, 0.6, 0.6)).apply_translation((0.0, -0.9, 0.9))]
    )
    even = mesh_to_sdf(one_sided, GRID, COARSE)
    np.testing.assert_allclose(even, even[:, :, ::-1], atol=1e-6)
    odd = mesh_to_sdf(one_sided, GRID, MeshOptions(voxel_m=0.05, symmetrise=False, are_cars=False))
    assert np.abs(odd - odd[:, :, ::-1]).max() > 0.1


def test_too_large_mesh_names_its_extents():
    with pytest.raises(MeshError, match="leave the grid"):
        mesh_to_sdf(box_on_the_ground().apply_scale(2.0), GRID, COARSE)


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "off", "stl"])
def test_axes_units_and_length(tmp_path, suffix):
    # In the file: front towards -y, up towards +x, centimetres, moved away from the origin; a mark shows the front.
    file_box = trimesh.creation.box((150.0, 400.0, 180.0))
    mark = trimesh.creation.box((10.0, 10.0, 10.0)).apply_translation((0.0, -205.0, 0.0))
    path = tmp_path / f"car.{suffix}"
    trimesh.util.concatenate([file_box, mark]).apply_translation((500.0, 30.0, -70.0)).export(path)
    mesh = load_mesh_obj(path, MeshOptions(forward_axis="-y", up_axis="+x", scale=0.01))
    np.testing.assert_allclose(mesh.bounds, [[-2.05, -1.5, -0.9], [2.05, 0.0, 0.9]], atol=1e-5)
    assert mesh.vertices[np.abs(mesh.vertices[:, 2]) < 0.06][:, 0].min() > 1.9  # the mark is in front
    assert mesh.volume > 0  # no mirror image
    scaled = load_mesh_obj(path, MeshOptions(forward_axis="-y", up_axis="+x", length_m=3.0))
    assert scaled.extents[0] == pytest.approx(3.0)


def test_unreadable_files_and_options(tmp_path):
    broken = tmp_path / "broken.ply"
    broken.write_text("not a mesh")
    with pytest.raises(DataFormatError, match=r"broken\.ply"):
        load_mesh_obj(broken)
    with pytest.raises(DataFormatError, match=r"missing\.obj"):
        load_mesh_obj(tmp_path / "missing.obj")
    with pytest.raises(InputError, match="up_axis: expected another axis"):
        MeshOptions(forward_axis="+x", up_axis="-x")
    with pytest.raises(InputError, match="scale: expected a finite number above 0"):
        MeshOptions(scale=0.0)


def test_flat_mesh_is_refused_by_name():
    triangle = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, -1, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(MeshError, match="a sheet: is flat"):
        mesh_to_sdf(triangle, GRID, COARSE, "a sheet")
