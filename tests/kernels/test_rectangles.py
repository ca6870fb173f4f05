"""Native rectangles are those of tensor operations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from directshape_torch.kernels.choice import without_kernels
from directshape_torch.start import rectangle_fit
from directshape_torch.start.rectangle_fit import InstancePoints, fit_rectangles


def points(count: int) -> InstancePoints:
    """Points around corners of cars at many places and headings; some weigh nothing, and some ends are hidden."""
    generator = torch.Generator().manual_seed(count)
    share, heading = torch.rand(count, 80, generator=generator), 6.3 * torch.rand(count, 1, generator=generator)
    at = torch.stack(
        [20 * torch.rand(count, generator=generator) - 10, 6 + 30 * torch.rand(count, generator=generator)], 1
    )
    along = torch.where(torch.arange(80) % 3 > 0, 4.0 * share, 0.0)
    across = torch.where(torch.arange(80) % 3 > 0, 0.0, 1.6 * share)
    xz = torch.stack(
        [heading.cos() * along + heading.sin() * across, heading.cos() * across - heading.sin() * along], -1
    )
    xz = xz + at[:, None] + 0.1 * torch.randn(count, 80, 2, generator=generator)
    weight = (torch.rand(count, 80, generator=generator) > 0.2) / 64.0
    column = xz[..., 0] / xz[..., 1]
    outline = torch.stack([column.amin(1), column.amax(1)], 1)
    return InstancePoints(xz, weight, xz.median(dim=1).values, outline, torch.rand(count, 2, generator=generator) > 0.3)


def both(seen: InstancePoints) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    with torch.no_grad():
        native = fit_rectangles(seen)
        with without_kernels():
            return native, fit_rectangles(seen)


def test_best_rectangles_are_those_of_tensor_operations() -> None:
    seen = points(60)
    (places, costs), (expected_places, expected_costs) = both(seen)
    assert not torch.equal(costs, expected_costs), "both were made in the same way"
    torch.testing.assert_close(costs.sort(1).values[:, 0], expected_costs.sort(1).values[:, 0], rtol=1e-3, atol=1e-5)
    best, expected = (
        p.gather(1, c.argmin(1)[:, None, None].expand(-1, 1, 5))[:, 0]
        for p, c in ((places, costs), (expected_places, expected_costs))
    )
    off = best - expected
    off[:, 2] = torch.sin(off[:, 2])  # A half turn gives the same rectangle.
    # Some instances have two rectangles of the same cost.
    assert (off.abs().amax(dim=1) < 2e-3).double().mean() > 0.9


@pytest.mark.parametrize("count", [0, 1])
def test_few_instances(count: int) -> None:
    native, expected = both(points(count))
    assert [x.shape for x in native] == [x.shape for x in expected]


def test_what_is_unknown_is_nowhere_and_leaves_others_alone() -> None:
    seen = points(3)
    broken = InstancePoints(*(x.clone() for x in seen))
    broken.middle[1] = torch.nan
    broken.weight[1] = torch.nan
    (places, costs), (_, expected) = both(broken)
    assert places[1].isnan().any(dim=1).all()
    assert costs[1].isnan().equal(expected[1].isnan())
    assert places[::2].equal(both(seen)[0][0][::2])


def test_places_beside_and_around_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without steps the costs are those of the given places, some around the camera, where no side is seen."""
    monkeypatch.setattr(rectangle_fit, "_NUM_ITERATIONS", 0)
    monkeypatch.setattr(rectangle_fit, "_RULES", rectangle_fit._RULES._replace(num_iterations=0))
    seen = points(1)
    places = torch.tensor([[[0.3, 0.2, 0.1, 4.0, 1.6], [0.2, 1.2, 1.5, 4.0, 1.6], [1.0, 9.0, 0.4, 4.0, 1.6]]])
    with torch.no_grad():
        native = rectangle_fit._improved(places, seen)
        with without_kernels():
            expected = rectangle_fit._improved(places, seen)
    torch.testing.assert_close(native[0], expected[0])
    assert native[1].isfinite().tolist() == expected[1].isfinite().tolist() == [[False, False, True]]
    torch.testing.assert_close(native[1][0, 2], expected[1][0, 2], rtol=1e-4, atol=0)
    # A corner behind the camera counts as one at the least depth.
    behind, seen = torch.tensor([[[3.0, 1.5, 1.5, 4.0, 1.6]]]), seen._replace(middle=0.005 * seen.middle)
    with torch.no_grad():
        native = rectangle_fit._improved(behind, seen)
        with without_kernels():
            expected = rectangle_fit._improved(behind, seen)
    assert expected[1].isfinite().all()
    torch.testing.assert_close(native[1], expected[1], rtol=1e-4, atol=0)
