import os
from pathlib import Path

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.shape.mesh_to_sdf import GridSpec, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance
from directshape_torch.shape.prior_quality import fit_code, leave_one_out_errors_cm


def balls(radii: list[float]) -> torch.Tensor:
    x = torch.linspace(-1, 1, 17, dtype=torch.float64)
    radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1).norm(dim=-1)
    return torch.stack([radius - r for r in radii])


def test_fit_recovers_a_code_and_measures_what_is_left():
    prior = PCAShapePrior.load_bundled().double()
    code = torch.linspace(-1, 1, prior.num_codes, dtype=torch.float64)
    exact = fit_code(prior, prior.values(code[None])[0])
    torch.testing.assert_close(exact.code, code, atol=1e-6, rtol=0)
    assert exact.mean_error_cm < 1e-6
    with pytest.raises(InputError, match="sdf: expected shape"):
        fit_code(prior, prior.mean[1:])
    with pytest.raises(InputError, match="nodes near the surface"):
        fit_code(prior, prior.mean + 10)


def test_leaving_one_ball_out_costs_nothing_but_a_cube_does():
    made = PriorProvenance("a test", "Apache-2.0", 5)
    samples = balls([0.4, 0.5, 0.6, 0.7, 0.8])
    origin = torch.full((3,), -1.0, dtype=torch.float64)
    prior = PCAShapePrior.fit(samples, origin, 0.125, 1, made)
    assert leave_one_out_errors_cm(samples, prior).max() < 1e-6
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
    sdf = torch.from_numpy(mesh_to_sdf(load_mesh_obj(file), GridSpec.for_cars()))
    prior = PCAShapePrior.load_bundled()
    assert fit_code(prior.with_num_codes(5), sdf).mean_error_cm < 3.0
    assert fit_code(prior, sdf).mean_error_cm < 2.8
