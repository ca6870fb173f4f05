import numpy as np
import pytest
import torch

from directshape_torch.errors import InputError, MeshError
from directshape_torch.geometry import se3
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh

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


def test_level_and_closure_at_the_border():
    bigger = sdf_to_mesh(NODES.norm(dim=-1) - 0.7, ORIGIN, 0.1, level_m=0.2)
    assert bigger.extents == pytest.approx([1.8] * 3, abs=0.01)
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
