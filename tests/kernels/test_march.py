"""Native marching finds what tensor operations find, whatever is in the call."""

from __future__ import annotations

import os

import pytest
import torch
from helpers.single_precision import in_single
from torch import Tensor

from directshape_torch.kernels.choice import native_grid, without_kernels
from directshape_torch.laboratory.bench import Bench
from directshape_torch.numerics.tables import take_rows
from directshape_torch.rows import Rays
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.terms.depth import Closest, Hits, marched_views

pytestmark = pytest.mark.usefixtures("no_gradients")

Call = tuple[Rays, Rays, Tensor, int, GridShape, Tensor]


def call_of(bench: Bench, num_samples: int = 24) -> Call:
    """The arguments of a march of a bench, float32."""
    field = bench.prepared.field
    assert isinstance(field, GridShape)
    sides = bench.problem.masks.of_sides
    return in_single((*sides, bench.problem.prior.bounds_obj, num_samples, field, bench.state.T_obj_cam))


def toy_call(size: tuple[int, int, int], seed: int = 0) -> Call:
    """Two cars of smooth random grids, a block of rays of the left and one of the right image each."""
    generator = torch.Generator().manual_seed(seed)
    nodes = torch.stack(torch.meshgrid(*(torch.linspace(-1, 1, n) for n in size), indexing="ij"))
    values = (nodes * torch.rand(2, 3, 1, 1, 1, generator=generator)).norm(dim=1) - 0.4
    last = torch.tensor([n - 1.0 for n in size])
    shape = GridShape.of(values, torch.zeros(*size, 2), -0.5 * last, 1.0)
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 2, 3] = torch.tensor([-9.0, -7.0])
    poses[:, :3, :3] += 0.1 * torch.randn(2, 3, 3, generator=generator)
    ray = torch.cat([0.1 * float(last.max()) * torch.randn(2, 2, 64, generator=generator), torch.ones(1, 2, 64)])
    left = Rays(torch.arange(2), torch.zeros(2, 3), ray)
    right = Rays(torch.arange(2), torch.tensor([[0.5, 0.0, 0.0]]).repeat(2, 1), ray.flip(2))
    return left, right, torch.stack([-0.5 * last, 0.5 * last]), 24, shape, poses


def by_tensors(call: Call) -> tuple[Closest, Hits]:
    with without_kernels():
        return marched_views(*call)


def natively(call: Call) -> tuple[Closest, Hits]:
    assert native_grid(call[4], call[2], call[5], call[0].ray_cam) is not None
    return marched_views(*call)


def same_bits(found: tuple[Closest, Hits], expected: tuple[Closest, Hits]) -> bool:
    return all(
        torch.equal(x.nan_to_num(1e30), y.nan_to_num(1e30))
        for a, b in zip(found, expected, strict=True)
        for x, y in zip(a, b, strict=True)
    )


def check_agreement(call: Call) -> None:
    """Where the least distance is flat its depth is loose, but the distance is not."""
    (closest, hits), (closest_, hits_) = natively(call), by_tensors(call)
    owner = torch.cat([call[0].owner, call[1].owner])
    assert torch.equal(closest.crosses, closest_.crosses)
    assert torch.equal(hits.found, hits_.found)
    crosses, found, field = closest.crosses, hits.found, call[4]
    apart = (closest.points_obj - closest_.points_obj)[:, ~crosses]
    torch.testing.assert_close(apart, torch.zeros_like(apart), rtol=0, atol=1e-4)
    least, least_ = (field.sdf(x.points_obj, owner)[crosses] for x in (closest, closest_))
    torch.testing.assert_close(least, least_, rtol=1e-5, atol=1e-5)
    apart = (closest.depth - closest_.depth).abs()[crosses]
    if len(apart):
        assert float(apart.quantile(0.98)) < 3e-5
    for x, y in ((hits.depth, hits_.depth), (hits.points_obj, hits_.points_obj)):
        torch.testing.assert_close(x[..., found], y[..., found], rtol=0, atol=3e-5)
    torch.testing.assert_close(hits.normal_obj, hits_.normal_obj, rtol=0, atol=1e-3)
    assert torch.equal(hits.points_obj[:, ~found], hits_.points_obj[:, ~found])


def test_marched_rays_are_those_of_tensor_operations_in_every_regime(bench: Bench) -> None:
    check_agreement(call_of(bench))


@pytest.mark.parametrize("size", [(2, 2, 2), (3, 2, 5), (9, 4, 6), (33, 17, 12)])
@pytest.mark.parametrize("num_samples", [1, 2, 24])
def test_grids_of_any_size_and_any_number_of_samples(size: tuple[int, int, int], num_samples: int) -> None:
    call = toy_call(size)
    check_agreement((*call[:3], num_samples, *call[4:]))


def test_a_call_without_right_rays_and_a_call_without_rays(typical: Bench) -> None:
    """There is nothing to write, and nothing else changes."""
    call = call_of(typical)
    none = take_rows(call[1], torch.tensor([], dtype=torch.long), "M")
    left_alone = call[0], none, *call[2:]
    check_agreement(left_alone)
    num_left = len(call[0].owner)
    assert torch.equal(natively(left_alone)[0].depth, natively(call)[0].depth[:num_left])
    closest, hits = natively((none, none, *call[2:]))
    assert closest.depth.shape == hits.depth.shape == (0, 64)


@pytest.mark.parametrize("what", ["pose x", "pose y", "pose z", "values", "ray"])
@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_gone_wrong_stay_with_their_car(what: str, number: float) -> None:
    call = toy_call((9, 4, 6))
    expected = natively(call)
    left, right, bounds, count, shape, poses = call
    if what.startswith("pose"):
        poses = poses.clone()
        poses[0, "xyz".index(what[-1]), 3] = number
    elif what == "values":
        shape = shape._replace(values=shape.values.index_fill(0, torch.tensor([0]), number))
    else:
        ray = left.ray_cam.clone()
        ray[0, 0, :] = number
        left = left._replace(ray_cam=ray)
    closest, hits = natively((left, right, bounds, count, shape, poses))
    others = [1, 3] if what != "ray" else [1, 2, 3]
    assert same_bits(
        (Closest(*(x[..., others, :] for x in closest)), Hits(*(x[..., [1], :] for x in hits))),
        (Closest(*(x[..., others, :] for x in expected[0])), Hits(*(x[..., [1], :] for x in expected[1]))),
    )
    assert not hits.found[0].any()
    if what.startswith("pose"):
        assert not closest.crosses[0].any()


def test_tensors_with_jumps_in_memory_give_the_same_bits(typical: Bench) -> None:
    call = call_of(typical)
    left, right, bounds, count, shape, poses = call
    stridden = (
        left._replace(ray_cam=left.ray_cam.permute(2, 1, 0).contiguous().permute(2, 1, 0)),
        right._replace(centre_cam=right.centre_cam.repeat(1, 2)[:, :3]),
        bounds.mT.contiguous().mT,
        count,
        shape._replace(values=shape.values.mT.contiguous().mT),
        poses.mT.contiguous().mT,
    )
    assert not stridden[0].ray_cam.is_contiguous()
    assert same_bits(natively(stridden), natively(call))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_has_the_same_bits() -> None:
    call = toy_call((9, 4, 6))
    expected = natively(call)
    child = os.fork()
    if child == 0:
        os._exit(0 if same_bits(natively(call), expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
