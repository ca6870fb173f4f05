"""Everything that a followed pixel adds to the sums, on a real grid, against autograd and loops over residuals."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from helpers.block_fields import objects_ahead, random
from helpers.ellipsoids import ellipsoid_prior
from helpers.photometric_blocks import (
    NUM_NEIGHBOURS,
    OWNER,
    SETTINGS,
    in_objects,
    residuals_one_by_one,
    residuals_one_by_one_values,
    rows_of,
)
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.tracking.field import BlockField, PackedBlockField, block_field
from directshape_torch.tracking.photometric import (
    Hits,
    PhotometricRows,
    PhotometricSettings,
    PhotometricSums,
    accumulate_photometric,
    depth_of_state,
    linearise_photometric,
    surface_under,
)

CODE = random(3, 3, seed=12, scale=0.5)


class Case(NamedTuple):
    prior: PCAShapePrior
    rows: PhotometricRows
    T_obj_cam: Tensor  # (B, 4, 4)
    hits: Hits

    @property
    def blocks(self) -> Tensor:
        return self.rows.rays.of_blocks(self.T_obj_cam)

    def field(self, code: Tensor = CODE) -> BlockField:
        return block_field(self.prior.bind(code))


@pytest.fixture(scope="module")
def case() -> Case:
    """Hits 3 cm off the surface."""
    prior, rows, T = ellipsoid_prior(), rows_of(), objects_ahead(3)
    field, rays = block_field(prior.bind(CODE)), in_objects(rows)
    depth = torch.linspace(5, 8, 200, dtype=torch.float64)[:, None, None].expand(-1, 4, 64)
    entered = (field.value(rays.at(depth), OWNER) < 0.03).to(torch.uint8).argmax(dim=0)
    points = rays.at(depth[0] + 3 * entered / 199)
    return Case(prior, rows, T, Hits(points, field.derivatives(points, OWNER).gradient))


class Expected(NamedTuple):
    residual: Tensor  # (M, 64, N)
    J: Tensor  # (M, 64, N, D)
    usable: Tensor


def expected_rows(case: Case, settings: PhotometricSettings) -> Expected:
    """J by autograd through the definition: the depth at which the moved shape has the same signed distance."""
    surface = surface_under(case.field(), case.rows, settings, case.blocks, case.hits)
    comparable = residuals_one_by_one(case.rows, settings, surface.depth)[1]

    def residuals(delta: Tensor) -> Tensor:
        T = case.rows.rays.of_blocks(se3.exp(delta[:6]) @ case.T_obj_cam)
        rays = case.rows.rays.in_objects(T)
        sdf = PackedBlockField(case.prior.bind(CODE + delta[6:])).value(rays.at(surface.near_depth), OWNER)
        return residuals_one_by_one_values(case.rows, settings, surface.depth - (sdf - sdf.detach()) / surface.slope)

    zero = torch.zeros(9, dtype=torch.float64)
    return Expected(residuals(zero), torch.func.jacfwd(residuals)(zero), surface.usable & comparable)


def huber(residual: float, corner: float) -> tuple[float, float]:
    """Value, and derivative over the residual."""
    r = abs(residual)
    return (0.5 * r * r, 1.0) if r <= corner else (corner * (r - 0.5 * corner), corner / r)


def assert_sums(
    found: PhotometricSums, rows: PhotometricRows, settings: PhotometricSettings, expected: Expected
) -> None:
    """Against loops over pixels and neighbours."""
    corner, lost = settings.huber_grey_levels, settings.lost_grey_levels
    truncated = 0
    for m in range(len(OWNER)):
        cost, gradient, matrix = 0.0, torch.zeros(9).double(), torch.zeros(9, 9).double()
        for i in range(64):
            for n in range(NUM_NEIGHBOURS):
                weight = float(rows.pixel_weight[m, i] * rows.neighbour_weight[n, m, i])
                r, J = float(expected.residual[m, i, n]), expected.J[m, i, n]
                cut = settings.truncated and abs(r) >= lost
                if not expected.usable[m, i] or cut:
                    truncated += cut
                    cost += weight * huber(lost, corner)[0]
                    continue
                rho, slope = huber(r, corner)
                cost += weight * rho
                gradient = gradient + weight * slope * r * J
                matrix = matrix + weight * slope * torch.outer(J, J)
        torch.testing.assert_close(float(found.cost[m]), cost, rtol=1e-9, atol=1e-9)
        scale = float(gradient.abs().max())
        torch.testing.assert_close(found.products[m, -1], gradient, rtol=1e-7, atol=1e-9 * scale)
        torch.testing.assert_close(found.products[m, :-1], matrix, rtol=1e-7, atol=1e-9 * float(matrix.abs().max()))
    assert truncated > 10 or not settings.truncated


@pytest.mark.parametrize("name", SETTINGS)
def test_sums_of_hand_derived_rows_against_autograd_of_single_residuals(case: Case, name: str) -> None:
    settings = SETTINGS[name]
    expected = expected_rows(case, settings)
    assert 40 < int(expected.usable.sum()) < 220
    with torch.no_grad():
        found = linearise_photometric(case.field(), case.rows, settings, case.blocks, case.hits)
        packed = PackedBlockField(case.prior.bind(CODE))
        other = linearise_photometric(packed, case.rows, settings, case.blocks, case.hits)
    assert_sums(found, case.rows, settings, expected)
    for x, y in zip(found, other, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-9)
    surface = surface_under(case.field(), case.rows, settings, case.blocks, case.hits)
    torch.testing.assert_close(found.points_obj, surface.hits.points_obj)
    torch.testing.assert_close(found.normal_obj, surface.hits.normal_obj)


@pytest.mark.parametrize("name", SETTINGS)
def test_sums_of_given_rows(case: Case, name: str) -> None:
    settings = SETTINGS[name]
    expected = expected_rows(case, settings)
    found = accumulate_photometric(case.rows, settings, *expected, case.hits)
    assert_sums(found, case.rows, settings, expected)
    assert torch.equal(found.points_obj, case.hits.points_obj)
    assert torch.equal(found.normal_obj, case.hits.normal_obj)


def test_the_depth_as_a_function_of_the_state(case: Case) -> None:
    """Its derivative is the hand-derived one, and that of a surface which is searched for at each displaced state."""
    settings = SETTINGS["plain"]
    surface = surface_under(case.field(), case.rows, settings, case.blocks, case.hits)

    def at(delta: Tensor) -> tuple[BlockField, Tensor]:
        return case.field(CODE + delta[6:]), case.rows.rays.of_blocks(se3.exp(delta[:6]) @ case.T_obj_cam)

    def depth(delta: Tensor) -> Tensor:
        field, T = at(delta)
        return depth_of_state(field, case.rows, T, surface)

    zero = torch.zeros(9, dtype=torch.float64)
    torch.testing.assert_close(depth(zero), surface.depth, rtol=0, atol=0)
    J = torch.func.jacfwd(depth)(zero)[surface.usable]
    torch.testing.assert_close(J, surface.J_depth_state[surface.usable], rtol=1e-9, atol=1e-12)
    size = 1e-4
    for k in range(9):
        step = size * torch.eye(9, dtype=torch.float64)[k]
        there = [
            surface_under(field, case.rows, settings, T, surface.hits)
            for field, T in (at(zero + step), at(zero - step))
        ]
        both = surface.usable & there[0].usable & there[1].usable
        slope = (there[0].depth - there[1].depth) / (2 * size)
        error = (slope - surface.J_depth_state[..., k])[both].abs()
        scale = surface.J_depth_state[both].norm(dim=-1)
        # The Jacobian is taken up to 3 cm beside the surface, in another grid cell for a few.
        assert float((error / scale).quantile(0.8)) < 0.02


def test_some_of_the_blocks(case: Case) -> None:
    kept, keep = torch.tensor([0, 1, 3]), torch.tensor([0, 1])
    some = case.rows.select(kept, torch.tensor([0, 0, 1]))
    settings = SETTINGS["plain"]
    everything = linearise_photometric(case.field(), case.rows, settings, case.blocks, case.hits)
    hits = Hits(*(x[:, kept] for x in case.hits))
    T = some.rays.of_blocks(case.T_obj_cam[keep])
    few = linearise_photometric(case.field(CODE[keep]), some, settings, T, hits)
    for found, whole in zip(few[:2], everything[:2], strict=True):
        assert torch.equal(found, whole[kept])
    for found, whole in zip(few[2:], everything[2:], strict=True):
        assert torch.equal(found, whole[:, kept])


def test_a_block_whose_numbers_are_broken_disturbs_no_other(case: Case) -> None:
    T = case.blocks.clone()
    T[2] = torch.nan
    settings = SETTINGS["plain"]
    broken = linearise_photometric(case.field(), case.rows, settings, T, case.hits)
    clean = linearise_photometric(case.field(), case.rows, settings, case.blocks, case.hits)
    others = torch.tensor([0, 1, 3])
    assert torch.equal(broken.cost[others], clean.cost[others])
    assert torch.equal(broken.products[others], clean.products[others])
    # Nothing of it is remembered: should the object come back to a state with numbers, its hits are still there.
    assert torch.equal(broken.points_obj[:, 2], case.hits.points_obj[:, 2])


def test_residuals_that_mean_nothing_do_not_reach_the_sums(case: Case) -> None:
    expected = expected_rows(case, SETTINGS["plain"])
    broken = torch.where(expected.usable[..., None], expected.residual, torch.nan)
    J = torch.where(expected.usable[..., None, None], expected.J, torch.nan)
    clean = accumulate_photometric(case.rows, SETTINGS["plain"], *expected, case.hits)
    found = accumulate_photometric(case.rows, SETTINGS["plain"], broken, J, expected.usable, case.hits)
    assert torch.equal(found.cost, clean.cost)
    assert torch.equal(found.products, clean.products)
