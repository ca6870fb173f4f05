"""This module tells which cars can be refined at all, and whether the parts of a call fit together."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import FOLLOWING
from directshape_torch.numerics.tensors import occurrences
from directshape_torch.observation.packing import Observation
from directshape_torch.scene.detections import Detections, check_instances
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.status import Status

# A car whose origin is nearer than this is at the camera, and its silhouette is no projection.
_MIN_DEPTH_M = 1.0
_DTYPES = (torch.float32, torch.float64)


def fitting(frames: FrameBatch, detections: Detections, prior: ShapePrior, others: Iterable[Tensor]) -> Detections:
    """The detections in the dtype of the frames, after a check that frames, detections and prior fit together.

    Args:
        frames: frames of a call, as the user gives them.
        detections: detections of the call, as the user gives them.
        prior: shape prior of the refiner.
        others: further tensors of the call, which must have no tangents of forward-mode differentiation.

    Raises:
        InputError: frames, detections and prior differ in dtype, device, mask size or frame numbers, or some tensor is
            a dual number of forward-mode differentiation.
    """
    detections = _in_dtype_of(frames, detections)
    if prior.origin.dtype not in _DTYPES:
        cure = "make it anew in float32, and leave it out of what .half() or .bfloat16() is called on"
        raise InputError("refiner", "shapes in float32 or float64", str(prior.origin.dtype), cure)
    for name, tensor, numbers in (*frames.tensors("frames"), *detections.tensors("detections")):
        wanted = prior.origin.dtype if numbers in FOLLOWING else tensor.dtype
        if tensor.dtype != wanted or tensor.device != prior.origin.device:
            raise InputError(
                name,
                f"dtype {wanted} on {prior.origin.device}, like the refiner",
                f"{tensor.dtype} on {tensor.device}",
                "move them together with .to(device, dtype)",
            )
    for of, of_kind in (("detections.", detections), ("detections.occluders.", detections.occluders)):
        if of_kind is not None:
            check_instances(frames, of_kind.frame_index, of_kind.mask_left, of_kind.mask_right, of)
    _check_times(detections, frames)
    of_prior = (tensor for _, tensor in (*prior.named_buffers(), *prior.named_parameters()))
    _check_no_tangents(frames, detections, (*others, *of_prior))
    return detections


def _in_dtype_of(frames: FrameBatch, detections: Detections) -> Detections:
    """The detections in the dtype of the frames; raises `InputError` for other records, and for half precision."""
    # Records are checked by their members and not by `isinstance`, so that a user's own record will do.
    needed = ("frames", frames, FrameBatch, "images_left"), ("detections", detections, Detections, "mask_left")
    for name, given, kind, member in needed:
        if not hasattr(given, member):
            raise InputError(name, f"a {kind.__name__}", type(given).__name__, "call it as refiner(frames, detections)")
    if frames.images_left.dtype not in _DTYPES:
        # This comes before the comparison of dtypes, whose message would ask for a refiner in half precision.
        raise InputError(
            "frames",
            "float32 or float64",
            str(frames.images_left.dtype),
            "refine outside of half precision: .to(dtype=torch.float32) of frames, detections and refiner",
        )
    return detections.in_dtype(frames.images_left.dtype)


def _check_no_tangents(frames: FrameBatch, detections: Detections, others: Iterable[Tensor]) -> None:
    """Raise `InputError` where some tensor of a call is a dual number of forward-mode differentiation.

    The iterations detach what they hold constant from gradients. Tangents would pass through it and come out wrong.
    """
    # Forward mode is on for the whole process, also by regions of other threads. What counts is whether these tensors
    # take part.
    declared = [each.value for record in (frames, detections) for each in record.tensors("")]
    field = frames.camera.disparity_field
    of_field = [] if field is None else [x for x in vars(field).values() if isinstance(x, Tensor)]
    if any(unpack_dual(x).tangent is not None for x in (*declared, *of_field, *others)):  # type: ignore[no-untyped-call]
        raise InputError(
            "refiner",
            "tensors without tangents of forward-mode differentiation (torch.func.jvp, jacfwd)",
            "some with",
            "differentiate in reverse mode: .backward(), torch.func.vjp or jacrev, with backward.mode",
        )


def _check_times(detections: Detections, frames: FrameBatch) -> None:
    """Raise `InputError` where two views of a track were taken at one time."""
    if detections.track_id is None or frames.time_s is None:
        return
    times = frames.time_s[detections.frame_index].tolist()
    seen: set[tuple[int, float]] = set()
    for view in zip(detections.track_id.tolist(), times, strict=True):
        if view[0] >= 0 and view in seen:
            cure = "take the time of the first frame off before they become float32, or leave times out"
            raise InputError("frames.time_s", "another time for each view of a track", f"{view[1]:g} s twice", cure)
        seen.add(view)


def stands_in_view(T_cam_obj: Tensor, ground_normal_cam: Tensor) -> Tensor:
    """Whether poses (B, 4, 4) are finite, before the camera and not upside down on the ground (B, 3)."""
    finite = T_cam_obj.isfinite().flatten(1).all(dim=1)
    return finite & (T_cam_obj[:, 2, 3] > _MIN_DEPTH_M) & ((T_cam_obj[:, :3, 1] * ground_normal_cam).sum(-1) < 0)


def refusals(cars: CarBatch, seen: Observation, config: RefinerConfig) -> Tensor:
    """The code (B,) of the status that forbids the refinement of each car, or -1."""
    T = cars.detector_T_cam_obj
    finite, in_view = T.isfinite().flatten(1).all(dim=1), stands_in_view(T, cars.ground_normal_cam)
    if seen.points is not None and not config.fits_images:
        lacking = [(seen.points.counts < config.point_cloud.min_points, Status.too_few_points)]
    else:
        lacking = _lacking_pixels(seen, config.sampling.min_usable_pixels)
    code = torch.full((len(cars),), -1, device=T.device)
    lacking += [(~in_view, Status.behind_camera), (~finite, Status.non_finite)]
    if cars.is_from_masks is not None:
        without, has_mask = ~finite & cars.is_from_masks, seen.mask_areas[:, 0] > 0
        lacking += [(without & has_mask, Status.no_start), (without & ~has_mask, Status.no_mask)]
    # Later statuses say more, so they replace earlier ones.
    for condition, status in lacking:
        code = torch.where(condition, torch.full_like(code, status.code), code)
    return code


def _lacking_pixels(pixels: Observation, least: int) -> list[tuple[Tensor, Status]]:
    areas = pixels.mask_areas
    left, right = (occurrences(x.object_index, len(areas)) for x in (pixels.left, pixels.right))
    # A region always has pixels, but masks that show next to nothing cannot tell a car from its surroundings.
    too_few = torch.minimum(left + right, areas.sum(dim=1)) < least
    # The texture of the left image is compared with the right one, so without a left mask nothing fixes a car's depth.
    return [(too_few, Status.too_few_pixels), (areas[:, 0] == 0, Status.no_mask)]
