"""This term compares the left image of a view with the left image of the next view, warped through the car's surface.

The cost is `1 / |Omega| sum_p w_p ||I_next(pi(T_next_obj X(p))) - I(p)||`, where X(p) is the surface under pixel p and
T_next_obj is the pose of the car in the next view. Both poses are unknown, so the motion of the camera need not be
known. Between two frames the car and the camera move by metres relative to each other, while the baseline of a rig is
half a metre. The term uses the pixels of the photometric term that the next view shows too. The derivation is in
docs/derivations/tracks.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.geometry import se3
from directshape_torch.image.interpolate import BilinearPatch, bilinear_patch
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.rows import Blocks, CarSums
from directshape_torch.shape.field import Field
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import CODE, POSE, State
from directshape_torch.terms import robust
from directshape_torch.terms.photometric import (
    Photometric,
    PhotometricEvidence,
    Surface,
    depth_of,
    is_grazing,
    matched_brightness,
    near_surface,
)
from directshape_torch.terms.photometric_rows import CENTRE, frame_view, is_on_mask
from directshape_torch.terms.term import Linear, Prepared, Term
from directshape_torch.tracks.state import NEXT_POSE, TrackState

NEXT_VIEW_NAME = "next_view"
# The next camera sees only points with at least this depth.
_LEAST_DEPTH_M = 0.1
# The likeness of two views allows a shift by this number of pixels of the pyramid level. The square of the floor is
# added to the variance of grey levels, so that weak noise on an even car makes no difference.
_MOST_SHIFT_PX, _CONTRAST_FLOOR = 3, 5.0


class NextViews(NamedTuple):
    """`NextViews` describes the next view of each of B views."""

    exists: Annotated[Tensor, Dense("B", kind="flags")]  # false for the last view of a track
    frame_index: Annotated[Tensor, Dense("B", kind="index")]
    detection_row: Annotated[Tensor, Dense("B", kind="index")]
    K_left: Annotated[Tensor, Dense("B", 3, 3)]

    @classmethod
    def of(cls, cars: CarBatch, next_view: Tensor) -> NextViews:
        """Next views from their numbers (B,); the last view of a track has its own number."""
        exists = next_view != torch.arange(len(next_view), device=next_view.device)
        return cls(exists, *(x[next_view] for x in (cars.frame_index, cars.detection_row, cars.K_left)))


class NextImage(NamedTuple):
    """`NextImage` holds what the pixels of M blocks are compared with in a stage."""

    pixels: Annotated[Tensor, Dense("A")]  # grey levels of all left images at the pyramid level, one after another
    frame: Annotated[Tensor, Dense("M", 4, kind="index")]  # see `RightView`
    K: Annotated[Tensor, Dense("M", 3, 3)]  # intrinsics of the next camera at the pyramid level
    grey: Annotated[Tensor, Dense("M", 64)]  # grey levels of the pixels, brought to the brightness of the next image
    weight: Annotated[Tensor, Dense("M", 64)]  # weights of the pixels; zero where the next view does not show the pixel

    def at(self, u: Tensor, v: Tensor) -> BilinearPatch:
        """The image at points (M, 64) of the pyramid level."""
        first_pixel, row_step, last_column, last_row = self.frame.mT[..., None]
        return bilinear_patch(self.pixels, first_pixel, row_step, u, v, last_column, last_row)


class LookedUp(NamedTuple):
    """`LookedUp` is what the next images show at points (3, M, 64) of cars."""

    u: Tensor  # (M, 64) column at the pyramid level
    v: Tensor  # (M, 64) row at the pyramid level
    value: Tensor  # (M, 64) grey levels
    J_value_point: Tensor  # (3, M, 64) per metre in the object frame
    inside: Tensor  # (M, 64) bool, whether the point is in the image and in front of the camera


@dataclass(frozen=True)
class NextViewEvidence(Table):
    """This `Evidence` is what the left images show of B views and of the next view of each."""

    weight: float  # of the term
    stereo: PhotometricEvidence  # photometric evidence of the B views
    next_views: NextViews  # next views of the B views

    names = (NEXT_VIEW_NAME,)

    def begin(self, stage: StageConfig, prepared: Prepared) -> NextView:
        stereo, left = self.stereo.begin(stage, prepared), self.stereo.left
        rows, owner = stereo.pixel_set.rows, stereo.blocks.owner
        images = left.pyramid[stage.image_level]
        scale, shift = images.scale, 0.5 * images.scale - 0.5
        K_left = self.next_views.K_left
        to_level = constant_like((scale, 0, shift, 0, scale, shift, 0, 0, 1), K_left).view(3, 3)
        K = (to_level @ K_left)[owner]
        frame = torch.cat(frame_view(images, self.next_views.frame_index[owner]), dim=1)
        grey = rows.intensity_left[CENTRE]
        everywhere = NextImage(images.left.reshape(-1), frame, K, grey, torch.ones_like(grey))
        begun = NextView(self.weight, stereo, self.next_views, everywhere)
        surface = near_surface(rows.rays, prepared.field, prepared.state, stereo.anchor(prepared))
        points = surface.rays.at(surface.depth)
        at = begun.looked_up(prepared.state, points)
        assert isinstance(prepared.state, TrackState)
        centre = prepared.state.T_obj_next[:, 0, :3, 3][owner].mT[..., None]
        towards = points - centre
        faces_it = ((surface.normal_obj * towards).sum(0) < 0) & ~is_grazing(surface.normal_obj, towards)
        u, v = ((x.detach() + 0.5) / scale - 0.5 for x in (at.u, at.v))
        on_car = is_on_mask(left.mask_left, self.next_views.detection_row[owner], u, v)
        shown = surface.found & at.inside & faces_it & on_car
        weight = rows.pixel_weight * (shown & self.next_views.exists[owner, None]).to(grey.dtype)
        counted = (weight > 0).to(grey.dtype)[None]
        form, right = stereo.config.brightness, at.value[None]
        matched = matched_brightness(form, grey[None], right, counted, owner, len(self.next_views.exists))[0]
        return replace(begun, image=everywhere._replace(grey=matched, weight=weight))


@dataclass(frozen=True)
class NextView(Term[Surface]):
    """A `NextView` is the term of a stage; the docstring of the module gives its cost."""

    weight: float  # of the term
    stereo: Photometric  # photometric term of the B views, with their pixels and surfaces
    next_views: NextViews  # next views of the B views
    image: NextImage  # what the pixels are compared with

    names = NextViewEvidence.names
    sees = (POSE, CODE, NEXT_POSE)

    @property
    def blocks(self) -> Blocks:
        return self.stereo.blocks

    @property
    def block_weight(self) -> Tensor:
        # The mean is over all pixels of the view, so that a few common pixels have little weight.
        return self.weight / self.stereo.pixel_set.support.clamp_min(1)[self.blocks.owner]

    @property
    def information(self) -> Tensor:
        return torch.full_like(self.block_weight, 1 / self.stereo.config.huber_grey_levels**2)

    @property
    def row_weight(self) -> Tensor:
        return self.image.weight[..., None]

    def looked_up(self, state: State, points_obj: Tensor) -> LookedUp:
        """What the next images show at points (3, M, 64) of cars."""
        assert isinstance(state, TrackState)
        image, owner = self.image, self.blocks.owner
        T_next_obj = se3.inverse(state.T_obj_next[:, 0])[owner]
        R, t = T_next_obj[:, :3, :3], T_next_obj[:, :3, 3]
        P = (image.K @ R).permute(1, 2, 0)[..., None]  # (3, 3, M, 1)
        moved = (image.K @ t[..., None])[..., 0].mT[..., None]
        x, y, z = P[:, 0] * points_obj[0] + P[:, 1] * points_obj[1] + P[:, 2] * points_obj[2] + moved
        in_front = z > _LEAST_DEPTH_M
        inverse_z = 1 / torch.where(in_front, z, 1.0)
        u, v = x * inverse_z, y * inverse_z
        at = image.at(u, v)
        J_u, J_v = ((P[n] - w * P[2]) * inverse_z for n, w in ((0, u), (1, v)))
        return LookedUp(u, v, at.value, at.d_u * J_u + at.d_v * J_v, at.inside & in_front)

    def anchor(self, prepared: Prepared) -> Surface:
        return self.stereo.anchor(prepared)

    def linear(self, field: Field, state: State, anchor: Surface) -> Linear[Surface]:
        surface = near_surface(self.stereo.pixel_set.rows.rays, field, state, anchor)
        points = surface.rays.at(surface.depth)
        at = self.looked_up(state, points)
        usable = surface.found & at.inside
        residual = torch.where(usable, at.value - self.image.grey, self.stereo.config.lost_grey_levels)
        J_depth = (at.J_value_point * surface.rays.direction_obj).sum(0)[..., None] * surface.J_depth_state
        J_value_point, points = at.J_value_point.movedim(0, -1), points.movedim(0, -1)
        # A point that is fixed in this camera moves in the next one by both poses, with opposite signs.
        J_pose = torch.cat([J_value_point, torch.linalg.cross(points, J_value_point)], dim=-1)
        J = torch.cat([J_depth + torch.nn.functional.pad(J_pose, (0, state.code.shape[1])), -J_pose], dim=-1)
        one = usable[..., None].to(J.dtype)
        return Linear(residual[..., None], one, J, surface.seen(anchor, surface.depth, usable))

    def residual(self, field: Field, state: State, anchor: Surface) -> Tensor:
        rays, owner = self.stereo.pixel_set.rows.rays.in_objects(state.T_obj_cam), self.blocks.owner
        at = self.looked_up(state, rays.at(depth_of(rays, owner, field, anchor)))
        lost = self.stereo.config.lost_grey_levels
        return torch.where(anchor.usable, at.value - self.image.grey, lost)[..., None]

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.huber(residual, self.stereo.config.huber_grey_levels)

    def likeness(self, prepared: Prepared) -> tuple[Tensor, Tensor]:
        """Return how alike (B,) each view and the next are, and how many pixels (B,) are seen in both.

        The likeness is the correlation of the grey levels of the pixels seen in both. It is the largest correlation
        over shifts of the next image by up to `_MOST_SHIFT_PX`, because views of one car may be slightly shifted.
        """
        anchor, owner, image = self.anchor(prepared), self.blocks.owner, self.image
        at = self.looked_up(prepared.state, anchor.points_obj)
        in_both = (anchor.usable & at.inside & (image.weight > 0)).to(torch.float64)
        sums = CarSums.of(owner, len(self.next_views.exists))

        def total(values: Tensor) -> Tensor:
            return sums.sum((in_both * values).sum(dim=1))

        count = total(in_both)
        noise = count * _CONTRAST_FLOOR**2

        def centred(grey: Tensor) -> tuple[Tensor, Tensor]:
            difference = grey - (total(grey) / count.clamp_min(1))[owner, None]
            return difference, total(difference * difference) + noise

        here, contrast_here = centred(image.grey)
        alike = torch.full_like(count, -1.0)
        for dv, du in product(range(-_MOST_SHIFT_PX, _MOST_SHIFT_PX + 1), repeat=2):
            there, contrast_there = centred(image.at(at.u + du, at.v + dv).value)
            correlation = (total(here * there) + noise) / (contrast_here * contrast_there).sqrt()
            alike = torch.fmax(alike, correlation)
        return alike, count
