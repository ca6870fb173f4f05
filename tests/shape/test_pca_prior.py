"""Components are those of a singular value decomposition, and fits to samples and unseen cars are the best ones."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from helpers.priors import first_components
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_sdf

from directshape_torch.errors import InputError
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.pca_fit import fit_car, fit_pca, leave_one_out_errors_cm, training_codes
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.shape.zero_level import zero_level_extents

MADE = PriorProvenance("a test", "Apache-2.0", 40)
SPACING_M = 0.2
SHAPE = (21, 13, 11)
ORIGIN = torch.tensor([-2.0, -2.0, -1.0], dtype=torch.float64)


def box_samples(count: int = 40, seed: int = 0) -> torch.Tensor:
    """Boxes on the ground with varying length and height and fixed width."""
    generator = torch.Generator().manual_seed(seed)
    axes = [ORIGIN[k] + SPACING_M * torch.arange(SHAPE[k], dtype=torch.float64) for k in range(3)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    length = 2.6 + 0.3 * torch.randn(count, generator=generator, dtype=torch.float64)
    height = 1.2 + 0.1 * torch.randn(count, generator=generator, dtype=torch.float64)
    samples = []
    for half_x, half_y in zip(0.5 * length, 0.5 * height, strict=True):
        q = torch.stack(
            [nodes[..., 0].abs() - half_x, (nodes[..., 1] + half_y).abs() - half_y, nodes[..., 2].abs() - 0.7]
        )
        samples.append(q.clamp_min(0).norm(dim=0) + q.amax(dim=0).clamp_max(0))
    return torch.stack(samples)


@pytest.fixture(scope="module")
def samples() -> torch.Tensor:
    return box_samples()


@pytest.fixture(scope="module")
def prior(samples) -> PCAShapePrior:
    return fit_pca(samples, ORIGIN, SPACING_M, 4, MADE)


@pytest.mark.parametrize("band_m", [None, 0.3])
def test_components_equal_those_of_a_singular_value_decomposition(samples, band_m):
    """Of distances that are weighed by how near their nodes are to the surfaces, or all alike."""
    prior = fit_pca(samples, ORIGIN, SPACING_M, 3, MADE, surface_band_m=band_m)
    near = torch.exp(-0.5 * (samples.flatten(1) / (band_m or torch.inf)) ** 2).mean(0)
    root = (near if band_m is None else near + 1e-3 * near.max()).sqrt()
    centred = (samples - samples.mean(0)).flatten(1) * root
    left, singular, directions = torch.linalg.svd(centred, full_matrices=False)
    sigma = singular[:3] / (len(samples) - 1) ** 0.5
    expected = directions[:3] * sigma[:, None]
    found = prior.basis.reshape(-1, 3).T * root
    signs = (found * expected).sum(1).sign()
    torch.testing.assert_close(found, expected * signs[:, None], atol=1e-9, rtol=0)
    torch.testing.assert_close(prior.explained_variance_ratio, singular[:3] ** 2 / (singular**2).sum())
    extents = zero_level_extents(samples, ORIGIN, SPACING_M)
    hwl = (extents[:, 1] - extents[:, 0])[:, [1, 2, 0]]
    code = left[:, :3] * (len(samples) - 1) ** 0.5 * signs
    torch.testing.assert_close(
        prior.dimensions_basis_hwl, torch.linalg.lstsq(code, hwl - hwl.mean(0)).solution.T, atol=1e-9, rtol=0
    )


def test_training_codes_are_white_and_give_the_samples_back(prior, samples):
    code = training_codes(samples, 4)
    torch.testing.assert_close(code.mean(0), torch.zeros(4, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(code.T.cov(), torch.eye(4, dtype=torch.float64), atol=1e-9, rtol=0)
    near = samples.abs() < 0.1
    assert (prior.values(code) - samples)[near].abs().mean() < 0.3 * (prior.mean - samples)[near].abs().mean()


def test_positive_first_code_makes_the_car_larger(prior):
    code = prior.initial_code(2)
    code[:, 0] = torch.tensor([-1.0, 1.0])
    small, large = zero_level_extents(prior.values(code), prior.origin, prior.spacing_m).diff(dim=1)[:, 0]
    assert large[0] > small[0] + 0.3


def test_linear_dimensions_follow_the_zero_level(prior):
    code = torch.tensor([[0.0, 0, 0, 0], [0.7, -0.5, 0, 0], [-1.0, 0.4, 0, 0]], dtype=torch.float64)
    extents = zero_level_extents(prior.values(code), prior.origin, prior.spacing_m)
    measured = (extents[:, 1] - extents[:, 0])[:, [1, 2, 0]]
    torch.testing.assert_close(prior.dimensions_and_derivative(code).hwl, measured, atol=0.06, rtol=0)


def test_state_dict_and_dtype(prior, samples):
    other = fit_pca(samples * 1.1, ORIGIN, 0.3, 4, MADE)
    other.load_state_dict(prior.state_dict())
    assert other.spacing_m == prior.spacing_m
    code = torch.ones(1, 4, dtype=torch.float64)
    torch.testing.assert_close(other.values(code), prior.values(code))
    single = first_components(prior, 4).to(torch.float32)
    assert single.values(single.initial_code(1)).dtype == torch.float32
    torch.testing.assert_close(single.values(code.float()).double(), prior.values(code), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("grid_dtype", "atol"), [(torch.float32, 1e-6), (torch.float16, 1e-3)])
def test_file_round_trip(prior, tmp_path, grid_dtype, atol):
    path = tmp_path / "prior.safetensors"
    prior.save(path, grid_dtype)
    read = PCAShapePrior.load(path)
    assert read.provenance == MADE
    assert read.spacing_m == prior.spacing_m
    code = torch.tensor([[0.5, -0.5, 0.5, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(read.values(code.float()).double(), prior.values(code), atol=3 * atol, rtol=0)
    torch.testing.assert_close(read.dimensions_basis_hwl.double(), prior.dimensions_basis_hwl, atol=1e-6, rtol=0)


@pytest.mark.parametrize("grid_dtype", [torch.int32, torch.bfloat16, "float16"])
def test_no_file_is_written_that_holds_no_grids(prior, tmp_path, grid_dtype):
    with pytest.raises(InputError, match=r"grid_dtype: expected torch\.float16 or torch\.float32"):
        prior.save(tmp_path / "prior.safetensors", grid_dtype)
    assert not any(tmp_path.iterdir())


def test_fit_refuses_samples_that_make_no_prior(samples):
    with pytest.raises(InputError, match="more than num_codes = 4"):
        fit_pca(samples[:4], ORIGIN, SPACING_M, 4, MADE)
    with pytest.raises(InputError, match="finite distances"):
        fit_pca(samples.where(samples > -0.3, torch.nan), ORIGIN, SPACING_M, 2, MADE)
    with pytest.raises(InputError, match="without surface"):
        fit_pca(samples.abs() + 0.1, ORIGIN, SPACING_M, 2, MADE)


def test_bundled_prior_is_a_car():
    prior = PCAShapePrior.load_bundled()
    assert 5 <= prior.num_codes <= 10
    assert prior.provenance.licence == "Apache-2.0"
    # KITTI's labelled cars: 1.53 +- 0.14, 1.63 +- 0.10, 3.88 +- 0.43 m.
    torch.testing.assert_close(prior.dimensions_mean_hwl, torch.tensor([1.53, 1.63, 3.88]), atol=0.06, rtol=0)
    torch.testing.assert_close(prior.dimensions_std_hwl, torch.tensor([0.14, 0.10, 0.43]), atol=0.04, rtol=0)
    extents = zero_level_extents(prior.values(prior.initial_code(1)), prior.origin, prior.spacing_m)[0]
    torch.testing.assert_close(extents[1] - extents[0], prior.dimensions_mean_hwl[[2, 0, 1]], atol=0.12, rtol=0)
    assert abs(extents[1, 1]) < 0.06  # the tyres stand on the ground
    torch.testing.assert_close(prior.mean, prior.mean.flip(2), atol=1e-3, rtol=0)


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
