import numpy as np
import pytest
from parametric_cars import surfaces as cars
from parametric_cars.measures import BODY_TYPES, sample_car

from directshape_torch.errors import InputError


@pytest.mark.parametrize("body_type", BODY_TYPES)
def test_mesh_is_a_closed_symmetric_car_of_its_measures(body_type):
    parameters = sample_car(5, body_type)
    mesh = cars.car_mesh(parameters, spacing_m=0.06)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert 0.35 < mesh.volume / (parameters.length * parameters.width * parameters.height) < 0.85
    np.testing.assert_allclose(
        mesh.extents, [parameters.length, parameters.height, parameters.width], atol=0.05, rtol=0
    )
    assert mesh.bounds[1, 1] == pytest.approx(0.0, abs=0.02)  # the tyres stand on the ground
    mirrored = np.sort(np.round(mesh.vertices[:, 2], 3))
    np.testing.assert_allclose(mirrored, -mirrored[::-1], atol=2e-3)


def test_signed_distance_is_that_to_the_mesh():
    parameters = sample_car(2, "saloon")
    mesh = cars.car_mesh(parameters, spacing_m=0.03)
    rng = np.random.default_rng(0)
    points, faces = mesh.sample(300, return_index=True, seed=0)
    offset = rng.uniform(-0.03, 0.03, 300)
    near = points + offset[:, None] * mesh.face_normals[faces]
    error = np.abs(cars.car_sdf(parameters, near) - offset)
    assert np.median(error) < 0.004
    assert np.mean(error < 0.015) > 0.95  # the rest lies at the grooves around the wheels
    far = np.array([[5.0, -0.5, 0.0]])
    assert cars.car_sdf(parameters, far)[0] == pytest.approx(5.0 - 0.5 * parameters.length, abs=0.1)


def test_dimensions_of_the_traffic_are_those_of_labelled_cars():
    # KITTI: height 1.53 +- 0.14, width 1.63 +- 0.10, length 3.88 +- 0.43 m.
    drawn = np.array([[c.height, c.width, c.length] for c in (sample_car(k) for k in range(600))])
    np.testing.assert_allclose(drawn.mean(axis=0), [1.53, 1.63, 3.88], atol=0.06)
    np.testing.assert_allclose(drawn.std(axis=0), [0.14, 0.10, 0.43], atol=0.04)
    assert {sample_car(k).body_type for k in range(300)} == set(BODY_TYPES)


def test_parts_lie_where_they_belong():
    parameters = sample_car(4, "hatchback")
    mesh = cars.car_mesh(parameters, spacing_m=0.05)
    labels = cars.car_part_labels(parameters, mesh.vertices)
    share = np.bincount(labels, minlength=cars.TRIM + 1) / len(labels)
    assert (share > 0.001).all()
    assert share.argmax() == cars.PAINT
    height = -mesh.vertices[:, 1]
    assert height[labels == cars.GLASS].min() > 0.5 * parameters.height
    assert height[labels == cars.TYRE].max() < 2 * parameters.wheel_radius + 0.05
    ends = np.abs(mesh.vertices[labels == cars.PLATE][:, 0])
    assert ends.min() > 0.4 * parameters.length


def test_wrong_input():
    with pytest.raises(InputError, match="body_type: expected one of city"):
        sample_car(0, "tank")
    with pytest.raises(InputError, match="spacing_m"):
        cars.car_mesh(sample_car(0), spacing_m=1.0)
    with pytest.raises(InputError, match="points_obj: expected shape"):
        cars.car_sdf(sample_car(0), np.zeros(3))
