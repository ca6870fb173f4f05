"""The lookups of signed distance that a Gauss-Newton iteration cannot avoid, as points to look up.

A ray whose contour is in play must know its least distance to the shape at the new state: three values about the depth
where it was closest correct that depth, a parabola needing three, and there value, gradient and code derivative make
residual and Jacobian. A pixel of the photometric set must know its depth: one value corrects it, and there the
derivatives are taken. Rays of which the contour is certain, and everything else, need none.

Not counted, because another method could do without: rays that an iteration carries along in case they come into play
later, empty places in blocks, lookups of pixels that turn out to see no surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.tracked_silhouettes import IN_PLAY_EXPONENT
from directshape_torch.tracking.silhouette import SAMPLE_DISTANCE_M


@dataclass(frozen=True)
class NeededLookups:
    """Points of one iteration: C rays near contours and S pixels with a surface.

    Attributes:
        contour_samples_obj: (3, 3, C) coordinates of three samples of each ray, for values.
        contour_obj: (3, C) the points of closest approach, for derivatives.
        contour_object: (C,) object of each ray.
        surface_obj: (3, S) where pixels meet the surface, for a value and for derivatives.
        surface_object: (S,)
    """

    contour_samples_obj: Tensor
    contour_obj: Tensor
    contour_object: Tensor
    surface_obj: Tensor
    surface_object: Tensor

    @property
    def num_values(self) -> int:
        """Lookups of a value alone."""
        return 3 * len(self.contour_object) + len(self.surface_object)

    @property
    def num_derivatives(self) -> int:
        """Lookups of value, gradient and code derivative."""
        return len(self.contour_object) + len(self.surface_object)


@torch.no_grad()
def needed_lookups(problem: CarProblem, state: CarState) -> NeededLookups:
    """The points at a state, in the last stage, which begins there.

    Args:
        problem: of B cars, with contours by closest approach.
        state: of these cars.
    """
    problem.begin_stage(problem.stages()[-1], state)
    projected = problem.project(state)
    contours, surfaces = [], []
    for term in problem.terms:
        if isinstance(term, SilhouetteTerm):
            contours.append(_contour_points(term, projected))
        elif isinstance(term, PhotometricTerm):
            surfaces.append(_surface_points(term, projected))
    samples, contour_object = (torch.cat(parts, dim=-1) for parts in zip(*contours, strict=True))
    surface, surface_object = (torch.cat(parts, dim=-1) for parts in zip(*surfaces, strict=True))
    return NeededLookups(samples, samples[:, 1].contiguous(), contour_object, surface, surface_object)


def _contour_points(term: SilhouetteTerm, projected: ProjectedState) -> tuple[Tensor, Tensor]:
    """Samples (3, 3, C) about the points of closest approach of the rays in play, and their objects (C,)."""
    view = term.view(projected)
    in_play = view.march.crosses_bounds & ((view.closest_sdf * term.zeta).abs() < IN_PLAY_EXPONENT)
    chosen = in_play.nonzero()[:, 0]
    rays = view.rays.select(chosen)
    step = SAMPLE_DISTANCE_M / rays.direction_obj.norm(dim=1)
    depth = view.closest_depth[chosen]
    points = [rays.at(depth + offset * step) for offset in (-1, 0, 1)]
    return torch.stack(points).permute(2, 0, 1).contiguous(), rays.object_index


def _surface_points(term: PhotometricTerm, projected: ProjectedState) -> tuple[Tensor, Tensor]:
    """Points (3, S) where the pixels of the set meet the surface, and their objects (S,)."""
    rays, root = projected.left.surface(term.pixel_set.pixel_index)
    found = root.found.nonzero()[:, 0]
    chosen = rays.select(found)
    return chosen.at(root.depth[found]).mT.contiguous(), chosen.object_index
