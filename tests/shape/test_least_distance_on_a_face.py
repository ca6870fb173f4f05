"""The least distance along a ray moves as docs/derivations/silhouette_closest_approach.md says, on cell faces too."""

from __future__ import annotations

import torch
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor

from directshape_torch.rows import ObjectRays
from directshape_torch.shape.field import field_of
from directshape_torch.terms.depth import Closest, along_face, closest_of_march, march

PRIOR = ellipsoid_prior()
FIELD = field_of(PRIOR.bind(torch.tensor([[0.7, -0.4, 0.5]], dtype=torch.float64)))
OWNER = torch.zeros(1, dtype=torch.long)
STEP = 1e-6


def rays(count: int = 512) -> ObjectRays:
    """Rays of one camera through points around the car, as many as fit into one block."""
    centre = torch.tensor([-9.0, -1.3, 0.8], dtype=torch.float64)
    low, high = PRIOR.bounds_obj
    targets = low + (high - low) * (0.1 + 0.8 * torch.rand(count, 3, dtype=torch.float64))
    return ObjectRays(centre.view(3, 1, 1), ((targets - centre) / 9.0).T[:, None].contiguous())


def closest(at: ObjectRays) -> Closest:
    return closest_of_march(FIELD, OWNER, at, PRIOR.bounds_obj, march(FIELD, OWNER, at, PRIOR.bounds_obj, 64))


def least(at: ObjectRays) -> Tensor:
    return FIELD.value(closest(at).points_obj, OWNER)


def moved(at: ObjectRays, axis: int, by: float) -> ObjectRays:
    centre = at.centre_obj.clone()
    centre[axis] += by
    return ObjectRays(centre, at.direction_obj)


def test_moving_the_ray_moves_the_least_distance_by_the_gradient_along_the_face() -> None:
    at = rays()
    found = closest(at)
    gradient = FIELD.derivatives(found.points_obj, OWNER).gradient
    corrected = along_face(gradient, at.direction_obj, found.face_obj)
    numeric = torch.stack([(least(moved(at, i, STEP)) - least(moved(at, i, -STEP))) / (2 * STEP) for i in range(3)])
    is_kink = (found.face_obj != 0).any(dim=0) & found.crosses
    is_smooth = ~is_kink & found.crosses
    assert int(is_kink.sum()) > 50
    assert int(is_smooth.sum()) > 10
    # A ray whose minimum is next to an edge of a cell changes its piece within the difference.
    for which in (is_kink, is_smooth):
        error = (corrected - numeric).abs().amax(dim=0)[which]
        assert float(error.quantile(0.97)) < 1e-5
    uncorrected = (gradient - numeric).abs().amax(dim=0)[is_kink]
    assert float(uncorrected.median()) > 1e-2


def test_the_gradients_of_both_cells_are_one_along_the_face() -> None:
    at = rays()
    found = closest(at)
    is_kink = (found.face_obj != 0).any(dim=0)
    either = [FIELD.derivatives(found.points_obj + side * 1e-9 * found.face_obj, OWNER).gradient for side in (-1, 1)]
    one, other = (along_face(g, at.direction_obj, found.face_obj)[:, is_kink] for g in either)
    assert float((either[0] - either[1])[:, is_kink].abs().amax(dim=0).median()) > 1e-2
    assert float((one - other).abs().amax(dim=0).quantile(0.97)) < 1e-6
