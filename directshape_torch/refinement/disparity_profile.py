"""The photometric cost over offsets of a car's disparity shows whether the state is in the right valley.

One curve belongs to the input and one to the end of the refinement, and both use equal pixels. A curve shows how far
and how sharply the images pull a state, and whether a repeated texture offers a second place. The hits of a state are
moved along their rays together, as if the whole visible surface had another disparity. Shape and contour stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.config import PhotometricConfig
from directshape_torch.errors import InputError
from directshape_torch.kernels.choice import array, takes_loops
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.numerics.tables import take_rows
from directshape_torch.numerics.tensors import made_once
from directshape_torch.rows import CarSums, Rays
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.photometric_rows import PhotometricRows, comparison, pixel_arrays, residuals_at
from directshape_torch.terms.robust import huber

# Two minima nearer to each other than this count as one minimum with a dent.
APART_PX = 0.75
# A second minimum could be the true one if its cost is below this factor times the lowest cost.
AMBIGUOUS_BELOW = 1.25
MAX_PIXELS = 100
"""By default a curve is made of at most this many pixels of a car, which takes half the time of all."""
_TINY = 1e-9
# The noise of cameras alone lets two images of one surface differ by this many grey levels.
_NOISE_GREY = 2.0
# This many residuals are computed at once. They take 1 MB in single precision; what does not fit into the caches takes
# longer.
_RESIDUALS_AT_ONCE = 250_000


class ProfileFigures(NamedTuple):
    """These are the figures of one curve for each of B cars. They are NaN and False where there is no curve.

    Attributes:
        offset_px: (B,) offset of the lowest cost, by the parabola through its neighbours. If the lowest cost is at an
            end of the range, this is that end.
        sigma_px: (B,) standard deviation of `offset_px`, from the curvature at the minimum and the cost that is left.
            It is infinite where the curve is flat or falls to an end.
        distinctness: (B,) cost of the best other minimum, at least 0.75 px away, divided by the lowest cost. It is
            infinite if there is no other minimum.
        ambiguous: (B,) bool, whether the best other minimum is nearly as low.
    """

    offset_px: Tensor
    sigma_px: Tensor
    distinctness: Tensor
    ambiguous: Tensor


@dataclass(frozen=True)
class DisparityProfile(CarRecord):
    """This is the photometric cost of B cars over n offsets of their disparity, with the pixels of the final stage.

    Attributes:
        offsets_px: (n,) evenly spaced offsets in pixels of the full resolution. A positive offset brings the car
            nearer.
        cost_before, cost_after: (B, n) cost of the photometric term at the input and at the end, without the factors of
            single cars. It is NaN for cars without pixels and for cars that were not refined.
        num_pixels: (B,) number of pixels of the curves.
        halves_apart: (B,) how much the costs of the upper, lower, left and right half of the pixels fall at the end
            when each half takes its own best disparity, as the sum of the logarithms of the ratios. Pixels of one car
            have a common best disparity.
    """

    shared = frozenset({"offsets_px"})

    offsets_px: Annotated[Tensor, Dense("n")]
    cost_before: Annotated[Tensor, Dense("B", "n")]
    cost_after: Annotated[Tensor, Dense("B", "n")]
    num_pixels: Annotated[Tensor, Dense("B")]
    halves_apart: Annotated[Tensor, Dense("B")]

    def cost_at(self, offset_px: float) -> tuple[Tensor, Tensor]:
        """Costs (B,) of both curves at the sample nearest to an offset."""
        column = (self.offsets_px - offset_px).abs().argmin(dim=0, keepdim=True)
        return self.cost_before.index_select(1, column)[:, 0], self.cost_after.index_select(1, column)[:, 0]

    @property
    def before(self) -> ProfileFigures:
        """Figures of the curve at the input."""
        return profile_figures(self.offsets_px, self.cost_before, self.num_pixels)

    @property
    def after(self) -> ProfileFigures:
        """Figures of the curve at the end; a good fit has one low minimum, near an offset of 0."""
        return profile_figures(self.offsets_px, self.cost_after, self.num_pixels)


def profile_offsets(range_px: float = 3.0, step_px: float = 0.25) -> Tensor:
    """Offsets (n,) from `-range_px` to `range_px` with 0 in the middle, float64.

    Raises:
        InputError: no positive range and step, or a range below two steps.
    """
    if not (step_px > 0 and range_px >= 2 * step_px):
        raise InputError("range_px, step_px", "a positive step and at least two of them", f"{range_px}, {step_px}")
    steps = int(range_px / step_px + 1e-9)
    return step_px * torch.arange(-steps, steps + 1, dtype=torch.float64)


@made_once
def _constant_offsets(_: torch.dtype, device: torch.device) -> Tensor:
    return profile_offsets().to(device)


def default_offsets(like: Tensor) -> Tensor:
    """A copy of `profile_offsets` on the device of a tensor; the owner of a result may write to it."""
    return _constant_offsets(like).clone()


def profile_figures(offsets_px: Tensor, cost: Tensor, num_pixels: Tensor) -> ProfileFigures:
    """Compute the figures of cost curves (B, n) at evenly spaced offsets (n,) that include 0.

    Each cost is a mean over `num_pixels` (B,) pixels.

    Examples:
        >>> offsets = profile_offsets()
        >>> figures = profile_figures(offsets, 2 + (offsets - 0.4)[None] ** 2, torch.tensor([100.0]))
        >>> figures.offset_px, figures.sigma_px
        (tensor([0.4000], dtype=torch.float64), tensor([0.1414], dtype=torch.float64))
    """
    known = cost.isfinite().all(dim=1)
    cost = torch.where(known[:, None], cost, 0.0)
    best = cost.argmin(dim=1)
    lowest = cost.gather(1, best[:, None])[:, 0]
    offset, sigma = _vertex(offsets_px, cost, best, num_pixels)
    other = _other_minimum(offsets_px, cost, best)
    # If the lowest cost is zero and another minimum is zero too, their ratio counts as 1.
    distinctness = torch.where(other > lowest, other / lowest, torch.ones_like(lowest))
    nan = torch.full_like(lowest, torch.nan)
    offset, sigma, distinctness = (torch.where(known, x, nan) for x in (offset, sigma, distinctness))
    return ProfileFigures(offset, sigma, distinctness, known & (distinctness < AMBIGUOUS_BELOW))


def _vertex(offsets_px: Tensor, cost: Tensor, best: Tensor, num_pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Find the offset (B,) and its standard deviation (B,) by the parabola through the lowest cost and its neighbours.

    The mean squared residual is twice the cost, which gives `sigma^2 = 2 cost / (curvature num_pixels)`.
    """
    inner = best.clamp(1, cost.shape[1] - 2)
    left, here, right = cost.gather(1, torch.stack([inner - 1, inner, inner + 1], dim=1)).unbind(dim=1)
    step = offsets_px[1] - offsets_px[0]
    curvature = (left - 2 * here + right) / step**2
    is_valley = (inner == best) & (curvature > 0)
    safe = torch.where(is_valley, curvature, torch.ones_like(curvature))
    shift = torch.where(is_valley, (left - right) / (2 * step * safe), torch.zeros_like(here))
    lowest = (here - 0.5 * safe * shift**2).clamp_min(0)
    sigma = (2 * lowest / (safe * num_pixels.clamp_min(1))).sqrt()
    return offsets_px[best] + shift, torch.where(is_valley, sigma, torch.full_like(sigma, torch.inf))


def _other_minimum(offsets_px: Tensor, cost: Tensor, best: Tensor) -> Tensor:
    """Cost (B,) of the second lowest local minimum; ends of the range count as minima, and infinity stands for none."""
    padded = torch.nn.functional.pad(cost, (1, 1), value=torch.inf)
    is_minimum = (cost <= padded[:, :-2]) & (cost <= padded[:, 2:])
    is_apart = (offsets_px - offsets_px[best][:, None]).abs() > APART_PX - 1e-6
    return torch.where(is_minimum & is_apart, cost, torch.inf).amin(dim=1)


@torch.no_grad()
def disparity_profile(
    term: Photometric | None,
    before: Surface | None,
    after: Surface | None,
    num_cars: int,
    like: Tensor,
    offsets_px: Tensor | None = None,
    max_pixels: int = MAX_PIXELS,
) -> DisparityProfile:
    """Compute the curves of B cars from the photometric term of a stage and the surface at the input and at the end.

    The offsets (n,) are evenly spaced and include 0. If a car has too many pixels, only every second, third, ... is
    used.
    """
    offsets = default_offsets(like) if offsets_px is None else offsets_px
    nothing = DisparityProfile.nothing({"B": num_cars, "n": len(offsets)}, like, offsets_px=offsets)
    if term is None or before is None or after is None:
        return nothing
    if not len(term.blocks.owner):
        return replace(nothing, num_pixels=torch.zeros_like(nothing.num_pixels))
    rows, place = _thinned(term, max_pixels)
    depth, on_surface = (
        torch.stack([x.flatten()[place], y.flatten()[place]])
        for x, y in ((before.depth, after.depth), (before.on_surface, after.on_surface))
    )
    per_px = -1 / (term.cars.K_right[:, 0, 0] * term.cars.T_right_cam[:, 0, 3])
    quarters = shifted_costs(rows, term.config, _quarters(rows), depth, on_surface, per_px, offsets.to(depth))
    weight = (rows.neighbour_weight.sum(dim=0) * (rows.pixel_weight > 0)).sum(dim=1, dtype=torch.float64)
    num_pixels = (rows.pixel_weight > 0).sum(dim=1)
    means = (term.config.weight * cost.mT / weight.clamp_min(1)[:, None] for cost in quarters.sum(dim=0))
    nowhere = num_pixels == 0
    at_input, at_end = (mean.masked_fill(nowhere[:, None], torch.nan) for mean in means)
    noise = huber(rows.pixel_weight.new_full((1,), _NOISE_GREY), term.config.huber_grey_levels).rho
    of_noise = (rows.pixel_weight * rows.neighbour_weight.sum(dim=0)).sum(dim=1, dtype=torch.float64) * noise
    halves_apart = _halves_apart(quarters[:, 1], offsets, of_noise).masked_fill(nowhere, torch.nan)
    return DisparityProfile(offsets, at_input, at_end, num_pixels.to(torch.float64), halves_apart)


def _quarters(rows: PhotometricRows) -> Tensor:
    """Whether pixels (4, B, R) lie in the upper left, upper right, lower left, lower right quarter of their car."""
    counts = (rows.pixel_weight > 0).to(rows.pixel_weight.dtype)
    uv = rows.rays.ray_cam[:2] / rows.rays.ray_cam[2]
    middle = (uv * counts).sum(dim=2, keepdim=True) / counts.sum(dim=1).clamp_min(1)[:, None]
    right, lower = uv > middle
    return torch.stack([~lower & ~right, ~lower & right, lower & ~right, lower & right]).to(counts.dtype)


def _halves_apart(quarters: Tensor, offsets_px: Tensor, of_noise: Tensor) -> Tensor:
    """`DisparityProfile.halves_apart` from the costs of quarters (4, n, B) and the cost of camera noise (B,)."""
    upper_left, upper_right, lower_left, lower_right = quarters
    halves = torch.stack(
        [upper_left + upper_right, lower_left + lower_right, upper_left + lower_left, upper_right + lower_right]
    )
    halves = halves + (0.5 * of_noise).clamp_min(_TINY)
    here = halves.index_select(1, offsets_px.abs().argmin(dim=0, keepdim=True))[:, 0]
    return (here / halves.amin(dim=1)).log().sum(dim=0)


def _thinned(term: Photometric, max_pixels: int) -> tuple[PhotometricRows, Tensor]:
    """Take every second, third, ... pixel of each car, and return these pixels and their places (B, R) in the pixel
    set.

    Every car has one block of R places, so that the host does not have to know how many pixels each car has.
    """
    fixed, num_cars = term.pixel_set, len(term.cars)
    sums = CarSums.of(fixed.blocks.owner, num_cars)
    counts = sums.sum(fixed.filled.sum(dim=1).to(torch.float64)).long()
    number = torch.arange(min(max_pixels, fixed.filled.numel()), device=counts.device)
    stride = (counts + max_pixels - 1) // max_pixels
    step = number * stride[:, None]
    # An empty place repeats the car's last pixel with weight 0. A pixel of another car could be NaN.
    first = sums.first.clamp_max(len(fixed.filled) - 1)
    place = first[:, None] * fixed.filled.shape[1] + step.minimum((counts - 1).clamp_min(0)[:, None])
    rows = fixed.rows
    rays = Rays(
        torch.arange(num_cars, device=first.device), rows.rays.centre_cam[first], rows.rays.ray_cam.flatten(1)[:, place]
    )
    along_ray, along_baseline, left, weight, neighbours = (x.flatten(-2)[..., place] for x in rows[1:6])
    weight = torch.where(step < counts[:, None], weight, torch.zeros_like(weight))
    right = take_rows(rows.right, first, "M")
    return PhotometricRows(rays, along_ray, along_baseline, left, weight, neighbours, right), place


def shifted_costs(
    rows: PhotometricRows,
    config: PhotometricConfig,
    parts: Tensor,  # (Q, B, R) which pixels count in each of Q costs, 0 or 1
    depth: Tensor,  # (S, B, R) of S surfaces, metres
    on_surface: Tensor,  # (S, B, R) bool
    per_px: Tensor,  # (B,) inverse depth that a pixel of disparity is worth
    offsets_px: Tensor,  # (n,)
) -> Tensor:
    """Costs (Q, S, n, B), float64, of Q parts of the pixels of each car, with S surfaces moved by n disparities."""
    if takes_loops(parts, depth, per_px, rows.along_ray, rows.intensity_left, rows.right.pixels):
        from directshape_torch.kernels.shifts import shifted  # Numba may be missing.

        shape = len(parts), len(depth), len(offsets_px), len(per_px)
        costs = torch.empty(shape, dtype=torch.float64, device=depth.device)
        tensors: list[Any] = [array(x) for x in (parts, depth, on_surface, per_px, offsets_px, costs)]
        shifted(pixel_arrays(rows), comparison(config), *tensors)
        return costs
    # If there are many pixels, the offsets are evaluated in parts, so that this needs no more memory than other
    # evaluations.
    num_parts = max(1, -(-rows.neighbour_weight.numel() * len(depth) * len(offsets_px) // _RESIDUALS_AT_ONCE))
    some = (
        _shifted_costs(rows, config, parts, depth, on_surface, per_px, of_part)
        for of_part in offsets_px.tensor_split(num_parts)
    )
    return torch.cat(list(some), dim=2)


@compilable
def _shifted_costs(
    rows: PhotometricRows,
    config: PhotometricConfig,
    parts: Tensor,
    depth: Tensor,
    on_surface: Tensor,
    per_px: Tensor,
    offsets_px: Tensor,
) -> Tensor:
    inverse = 1 / depth[:, None] + offsets_px[:, None, None] * per_px[:, None]
    residual, comparable = residuals_at(rows, 1 / inverse)
    usable = on_surface[:, None] & comparable & (inverse > 0)
    rho = huber(torch.where(usable[..., None], residual, config.lost_grey_levels), config.huber_grey_levels).rho
    cost = (rho * (rows.pixel_weight[..., None] * rows.neighbour_weight.movedim(0, -1))).sum(-1)
    return torch.stack([(cost * part).sum(-1) for part in parts.unbind()]).to(torch.float64)
