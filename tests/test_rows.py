"""Blocks of 64 rows: layout, joining, leaving cars out, their sums against loops over rows, and rays in blocks."""

from __future__ import annotations

import pytest
import torch
from helpers.twists import twists
from reference.rays import RaysObj
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.rows import Blocks, CarSums, ObjectRays, Rays, Rows
from directshape_torch.terms.term import weighted_products

COUNTS = [[0], [3], [64], [65, 0, 1], [130, 64, 0, 200], [0, 0, 5], []]
UNKNOWNS = 4


def car_of(counts: list[int]) -> Tensor:
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(counts, dtype=torch.long))


@pytest.mark.parametrize("counts", COUNTS)
def test_every_row_has_one_place_and_empty_places_repeat_their_own_car(counts: list[int]) -> None:
    car = car_of(counts)
    rows = Rows.of_sorted(car, len(counts))
    assert rows.row[rows.filled].tolist() == list(range(len(car)))
    assert torch.equal(rows.row.flatten()[rows.places], torch.arange(len(car)))
    assert torch.equal(car[rows.row], rows.blocks.owner[:, None].expand_as(rows.row))
    assert rows.blocks.counts == tuple(-(-count // 64) for count in counts)


@pytest.mark.parametrize("counts", COUNTS)
def test_sums_against_a_loop(counts: list[int]) -> None:
    """Cost, gradient and matrix of each car from the products of its blocks."""
    car, num_cars = car_of(counts), len(counts)
    J = torch.randn(len(car), UNKNOWNS, dtype=torch.float64)
    first, second = torch.randn(2, len(car), dtype=torch.float64)
    lam = torch.arange(1, num_cars + 1, dtype=torch.float64)
    expected = torch.zeros(num_cars, UNKNOWNS + 1, UNKNOWNS, dtype=torch.float64)
    for row, b in enumerate(car.tolist()):
        expected[b, :-1] += lam[b] * second[row] * torch.outer(J[row], J[row])
        expected[b, -1] += lam[b] * first[row] * J[row]
    rows = Rows.of_sorted(car, num_cars)
    of_rows = (torch.where(rows.filled, x[rows.row], 0.0) for x in (first, second))
    owner = rows.blocks.owner
    found = CarSums.of(owner, num_cars).sum(weighted_products(J[rows.row], *of_rows), lam[owner])
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_sums_are_of_a_car_alone_to_the_bit_whatever_the_others_have() -> None:
    own = torch.randn(4, 3, dtype=torch.float64)
    alone = CarSums.of(torch.zeros(4, dtype=torch.long), 1).sum(own)
    beside = torch.full((40, 3), torch.nan, dtype=torch.float64)
    owner = torch.ones(40, dtype=torch.long)
    owner[[3, 9, 10, 30]], beside[[3, 9, 10, 30]] = 0, own
    found = CarSums.of(owner, 2).sum(beside)
    assert torch.equal(found[0], alone[0])
    assert found[1].isnan().all()


def test_products_of_single_precision_rows_leave_in_double() -> None:
    J, first = torch.randn(1, 64, UNKNOWNS), torch.randn(1, 64)
    products = weighted_products(J, first, first)
    exact = weighted_products(J.double(), first.double(), first.double())
    assert products.dtype == torch.float64
    torch.testing.assert_close(products, exact, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("keep", [[0, 1, 2, 3], [0, 3], [1], [2, 3], []])
def test_cars_that_leave_take_their_blocks_along(keep: list[int]) -> None:
    sides = [Rows.of_sorted(car_of(counts), 4).blocks for counts in ([130, 0, 64, 3], [5, 70, 0, 300])]
    blocks = Blocks.join(sides)
    assert blocks.counts == (4, 2, 1, 6)
    assert blocks.owner.tolist() == [0, 0, 0, 2, 3, 0, 1, 1, 3, 3, 3, 3, 3]
    kept = torch.zeros(4, dtype=torch.bool)
    kept[keep] = True
    fewer, chosen = blocks.of_cars(kept, keep)
    assert torch.equal(chosen, kept[blocks.owner].nonzero()[:, 0])
    assert [keep[b] for b in fewer.owner.tolist()] == blocks.owner[chosen].tolist()
    assert fewer.counts == tuple(torch.bincount(fewer.owner, minlength=len(keep)).tolist())


def test_one_block_of_every_car() -> None:
    blocks = Blocks.one_each(3, torch.device("cpu"))
    values = torch.randn(3, 2, dtype=torch.float64)
    assert blocks.counts == (1, 1, 1)
    assert torch.equal(CarSums.of(blocks.owner, 3).sum(values), values)


def _rays(counts: list[int]) -> tuple[Rays, Rows, Tensor, Tensor, Tensor]:
    """Rays in blocks, how they fill them, and centres and rays (P, 3) of the rows; poses of the cars."""
    car = car_of(counts)
    rows = Rows.of_sorted(car, len(counts))
    centre = torch.randn(len(counts), 3, dtype=torch.float64)[car]
    ray = torch.cat([0.3 * torch.randn(len(car), 2, dtype=torch.float64), torch.ones(len(car), 1).double()], dim=1)
    return Rays.of_rows(rows, centre, ray), rows, centre, ray, se3.exp(twists("normal", len(counts)))


def test_rays_in_the_frames_of_their_cars() -> None:
    rays, rows, centre, ray, T_obj_cam = _rays([65, 0, 3])
    depth = 1 + 10 * torch.rand(5, *rows.row.shape, dtype=torch.float64)
    found = rays.in_objects(T_obj_cam).at(depth)
    points_cam = centre[rows.row] + depth[..., None] * ray[rows.row]
    expected = se3.transform(T_obj_cam[rows.blocks.owner][:, None], points_cam)
    torch.testing.assert_close(found, expected.movedim(-1, 0), rtol=1e-12, atol=1e-12)


def test_where_rays_come_next_to_points_and_cross_bounds() -> None:
    rays, _, _, _, T_obj_cam = _rays([70, 40])
    T_obj_cam = T_obj_cam.clone()
    T_obj_cam[:, :3, 3] = torch.tensor([0.0, 0.0, -9.0])
    in_objects = rays.in_objects(T_obj_cam)
    points = torch.randn_like(in_objects.direction_obj)
    depth = in_objects.depth_next_to(points)
    off = points - in_objects.at(depth)
    assert (off * in_objects.direction_obj).sum(0).abs().max() < 1e-12
    bounds = torch.tensor([[-2.0, -1.5, -1.0], [2.0, 0.5, 1.0]], dtype=torch.float64)
    found = in_objects.interval(bounds)
    centre = in_objects.centre_obj.expand_as(points).movedim(0, -1)
    flat = (x.reshape(-1, 3) for x in (centre, in_objects.direction_obj.movedim(0, -1)))
    near, far, hit = (x.view(found.near.shape) for x in RaysObj(torch.empty(0), *flat).interval(bounds))
    assert torch.equal(found.hit, hit)
    assert 0 < float(found.hit.double().mean()) < 1
    assert found.near.isfinite().all()
    for x, y, planes in ((found.near, near, found.enters), (found.far, far, found.leaves)):
        torch.testing.assert_close(x[found.hit], y[found.hit])
        # Where the point lies on a plane of the bounds, that is the one named.
        named = (planes == x) & found.hit
        assert (named.any(0) | (x == 0))[found.hit].all()
        distance = (in_objects.at(x)[:, None] - bounds.T[..., None, None]).abs().amin(dim=1)
        assert distance[named].max() < 1e-9


def test_intervals_by_hand() -> None:
    """Straight at the box, over it, at half speed, from inside, with the box behind, and nowhere."""
    bounds = torch.tensor([[-2.0, -1.5, -0.9], [2.1, 0.2, 0.9]], dtype=torch.float64)
    centres = torch.tensor([[-5.0, 0, 0], [-5.0, 0.3, 0], [0, 0, 5.0], [0, 0, 0], [5.0, 0, 0], [0, 0, 0]]).double()
    directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [0, 0, -0.5], [1.0, 0, 0], [1.0, 0, 0], [torch.nan, 0, 0]])
    found = ObjectRays(centres.T[..., None], directions.double().T[..., None]).interval(bounds)
    assert found.hit[:, 0].tolist() == [True, False, True, True, False, False]
    torch.testing.assert_close(found.near[[0, 2, 3], 0], torch.tensor([3.0, 8.2, 0.0]).double())
    torch.testing.assert_close(found.far[[0, 2, 3], 0], torch.tensor([7.1, 11.8, 2.1]).double())
    assert torch.isfinite(found.near).all()


def test_no_blocks_at_all() -> None:
    sums = CarSums.of(torch.zeros(0, dtype=torch.long), 2)
    assert sums.sum(torch.zeros(0)).tolist() == [0.0, 0.0]
    assert sums.sum(torch.zeros(0, 3, 2), torch.zeros(0)).equal(torch.zeros(2, 3, 2))
