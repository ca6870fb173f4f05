import os
from pathlib import Path

import pytest
import torch
from helpers.priors import first_components
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_sdf

from directshape_torch.errors import InputError
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.pca_fit import fit_car, fit_pca, leave_one_out_errors_cm
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance


def balls(radii: list[float]) -> torch.Tensor:
    x = torch.linspace(-1, 1, 17, dtype=torch.float64)
    radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1).norm(dim=-1)
    return torch.stack([radius - r for r in radii])


def test_fit_finds_a_shape_of_the_prior_again() -> None:
    prior = PCAShapePrior.load_bundled()
    code = prior.initial_code(1)
    code[0, 0], code[0, 1] = 1.2, -0.8
    found, error_cm = fit_car(prior, prior.values(code)[0])
    assert error_cm < 0.1
    torch.testing.assert_close(found, code[0], atol=0.05, rtol=0)
    code[0, 0] = 6.0
    assert fit_car(prior, prior.values(code)[0])[0].abs().max() == 3


def test_fit_of_an_unseen_car_is_the_least_squares_one() -> None:
    prior = PCAShapePrior.load_bundled()
    nodes = GridSpec.for_cars().nodes()
    distance = car_sdf(sample_car(123_456, "saloon"), nodes.reshape(-1, 3)).reshape(nodes.shape[:-1])
    truth = torch.from_numpy(distance).float()
    near = truth.abs() <= 0.07
    code = torch.linalg.lstsq(prior.basis[near].double(), (truth - prior.mean)[near][:, None].double()).solution[:, 0]
    assert code.abs().max() < 3
    found, error_cm = fit_car(prior, truth)
    torch.testing.assert_close(found.double(), code, atol=0.02, rtol=0)
    left = (prior.mean + prior.basis @ code.float() - truth)[near]
    assert error_cm == pytest.approx(100 * float(left.abs().mean()), rel=0.01)


def test_fit_refuses_another_grid_and_a_field_without_surface() -> None:
    prior = PCAShapePrior.load_bundled()
    with pytest.raises(InputError, match="truth"):
        fit_car(prior, torch.zeros(3, 3, 3))
    with pytest.raises(InputError, match="near the surface"):
        fit_car(prior, torch.full_like(prior.mean, 5.0))


def test_leaving_one_ball_out_costs_nothing_but_a_cube_does():
    made = PriorProvenance("a test", "Apache-2.0", 5)
    samples = balls([0.4, 0.5, 0.6, 0.7, 0.8])
    origin = torch.full((3,), -1.0, dtype=torch.float64)
    prior = fit_pca(samples, origin, 0.125, 1, made)
    assert leave_one_out_errors_cm(samples, prior).max() < 1e-3
    x = torch.linspace(-1, 1, 17, dtype=torch.float64)
    cube = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1).abs().amax(dim=-1) - 0.5
    with_cube = leave_one_out_errors_cm(torch.cat([samples, cube[None]]), prior)
    assert with_cube.argmax() == 5
    assert with_cube[5] > 1.0
    assert len(leave_one_out_errors_cm(samples, prior, most=3)) == 3
    with pytest.raises(InputError, match="at least 3"):
        leave_one_out_errors_cm(samples[:2], prior)


def test_bundled_prior_takes_on_a_real_saloon():
    root = os.environ.get("DIRECTSHAPE_DATA")
    if root is None:
        pytest.skip("DIRECTSHAPE_DATA is not set: no real meshes at hand")
    file = Path(root) / "meshes" / "comrade1280" / "sedan.obj"
    sdf = torch.from_numpy(mesh_to_sdf(load_mesh_obj(file), GridSpec.for_cars(), MeshOptions(voxel_m=0.04)))
    prior = PCAShapePrior.load_bundled()
    assert fit_car(first_components(prior, 5), sdf)[1] < 3.0
    assert fit_car(prior, sdf)[1] < 2.8
