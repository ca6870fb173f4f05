"""This module has public calls with tensors and numbers, and replaces any argument by an odd value."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import cached_street
from tensor_values import MUTATIONS, NUMBERS
from torch import Tensor

from directshape_torch import (
    Detections,
    DirectShapeRefiner,
    DisparityField,
    FrameBatch,
    GroundPlane,
    Occluders,
    PCAShapePrior,
    RefinementResult,
    RigEstimate,
    StereoCamera,
    check_scene,
    fit_shape,
    load_config,
)
from directshape_torch.config import RefinerConfig
from directshape_torch.rig.detections import COLUMNS
from directshape_torch.rig.rig_file import load_rigs
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.pca_fit import fit_pca
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.terms.lidar import LidarPoints
from directshape_torch.visualize.overlay import overlay

QUICK = ("stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 1}]", "point_cloud.weight=30")
Place = tuple[str, ...]
Arguments = Mapping[str, Any]


@dataclass(frozen=True)
class Call:
    """A `Call` is a call with good arguments.

    Attributes:
        arguments: tensors, records of tensors, numbers, texts.
        run: function that returns the values which must be finite if the call is accepted.
        promises: whether results are finite for any input, or only for finite input.
    """

    arguments: Arguments
    run: Callable[[Arguments], list[Tensor]]
    promises: bool = False

    def places(self) -> list[Place]:
        """All places that an odd value can take."""
        found: list[Place] = []
        for name, value in self.arguments.items():
            found += list(places(value, (name,))) if is_dataclass(value) else [(name,)]
        return found


@dataclass(frozen=True)
class OddCall:
    """An `OddCall` is a call with an odd value in one place; `outcome` runs it.

    Attributes:
        name: names of the call and of the place, to find it again.
        keeps_finite: whether its results must be finite.
    """

    name: str
    call: Call
    place: Place
    value: object
    keeps_finite: bool

    def outcome(self) -> bool:
        """Whether all values are finite that must be; the errors of the call are raised."""
        found = self.call.run(_changed(self.call.arguments, self.place, self.value))
        return not self.keeps_finite or all(bool(x.detach().isfinite().all()) for x in found)


def odd_call(chance: random.Random, name: str | None = None) -> OddCall:
    """Any call, or the call with the given name, with one odd value."""
    name = name or chance.choice(list(calls()))
    call = calls()[name]
    place = chance.choice(call.places())
    good = at(call.arguments[place[0]], place[1:])
    while True:
        if isinstance(good, Tensor):
            kind = chance.choice(list(MUTATIONS))
            try:
                value = MUTATIONS[kind](good, chance)
            except (RuntimeError, NotImplementedError):  # PyTorch has none such
                continue
        elif name == "settings":
            kind = value = setting(chance)
        else:
            value = chance.choice(NUMBERS)
            kind = repr(value)
        return OddCall(f"{name}: {'.'.join(place)}: {kind}", call, place, value, call.promises or _is_finite(value))


def odd_numbers(name: str) -> Iterator[OddCall]:
    """The named call with each odd value in place of each argument that is not a tensor."""
    call = calls()[name]
    for place in call.places():
        if not isinstance(at(call.arguments[place[0]], place[1:]), Tensor):
            for value in NUMBERS:
                finite = call.promises or _is_finite(value)
                yield OddCall(f"{name}: {'.'.join(place)}: {value!r}", call, place, value, finite)


def setting(chance: random.Random) -> str:
    """A text `KEY=VALUE` with a setting that exists."""
    group, key = chance.choice(_settings())
    value = chance.choice(
        ("-1", "0", "1", "2", "0.5", "1e-30", "1e30", ".nan", ".inf", "x", "null", "true", "[]", "[1]")
    )
    return f"{group}.{key}={value}"


@cache
def _settings() -> list[tuple[str, str]]:
    groups = ((each.name, getattr(RefinerConfig(), each.name)) for each in fields(RefinerConfig))
    return [(name, each.name) for name, group in groups if is_dataclass(group) for each in fields(group)]


@cache
def calls() -> dict[str, Call]:
    """All calls, by name."""
    frames, detections = whole_call()
    camera, prior = frames.camera, ellipsoid_prior()
    P_left = torch.cat([camera.K_left, torch.zeros(1, 3, 1)], dim=2).double()
    P_right = torch.cat([camera.K_right, camera.K_right @ camera.T_right_cam[:, :3, 3:]], dim=2)
    rig = {"K_left": camera.K_left[0], "K_right": camera.K_right[0], "T_right_cam": camera.T_right_cam[0]}
    of_prior = {name: getattr(prior, name) for name in _PRIOR_TENSORS} | {"spacing_m": prior.spacing_m}
    field = {"coefficients": torch.zeros(10).double(), "hull_uv": torch.tensor([[0.0, 0], [9, 0], [9, 9]]).double()}
    weight = torch.ones(2, dtype=torch.float64)
    street = {"frames": frames, "detections": detections}
    boxes = torch.tensor([[0.0, 0, 10, 4, 1.6, 1.5, 0.3]]).double()
    points = boxes[:, :3] + 0.7 * torch.randn(99, 3, generator=torch.Generator().manual_seed(0)).double()
    return {
        "refine": Call(street | {"weight": weight}, _refine, promises=True),
        "gradient": Call(street | {"weight": weight}, _gradient, promises=True),
        "settings": Call({"setting": ""}, _configured, promises=True),
        "prior": Call(of_prior, _prior, promises=True),
        "rig": Call(street, _rig),
        "rig matrices": Call({"size_wh": (160, 120), **rig}, _rig_of_matrices),
        "rig rows": Call({"rows": torch.zeros(3, len(COLUMNS)).double()}, _rig_rows),
        "field": Call(field | rig | {"uv": torch.zeros(5, 2).double()}, _field),
        "projections": Call({"P_left": P_left, "P_right": P_right}, _projections),
        "camera height": Call({"height_m": 1.65}, lambda a: [GroundPlane.from_camera_height(a["height_m"]).offset]),
        "images": Call(
            {"images_left": frames.images_left, "images_right": frames.images_right, "camera": camera}
            | {"ground": 1.65, "frame_ids": ("000000",)},
            lambda a: [FrameBatch.from_images(**a).images_left],
        ),
        "intrinsics": Call(
            {"K": camera.K_left, "baseline_m": 0.5, "K_right": camera.K_right},
            lambda a: [StereoCamera.from_intrinsics(**a).T_right_cam],
        ),
        "boxes": Call(_boxes(detections) | {"mask_left": list(detections.mask_left.dense())}, _from_boxes),
        "boxes of a LiDAR": Call(
            _boxes(detections) | {"convention": "nuscenes", "T_cam_boxes": torch.eye(4).double()}, _from_boxes
        ),
        "fit shape": Call({"points": points, "boxes": boxes, "convention": "opencv", "prior": prior}, _fit),
        "check scene": Call(street | {"match_images": False}, lambda a: [torch.tensor(len(str(check_scene(**a))))]),
        "state": Call(dict(_result().state_dict()), lambda a: _of_refined(_loaded(a)), promises=True),
        "some cars": Call({"index": torch.tensor([True, False])}, lambda a: [_result()[a["index"]].T_cam_obj]),
        "words": Call({"convention": "kitti", "frame": "cam"}, lambda a: [_result().to_boxes(**a)]),
        "rig state": Call({"state": RigEstimate.of_frames(frames).get_extra_state()}, _rig_state),
        "fit prior": Call({"samples": prior.values(torch.eye(3, prior.num_codes).double()), **_FIT}, _fitted_prior),
        "overrides": Call({"path": None, "overrides": ["check=off"]}, lambda a: [_number(load_config(**a))]),
        "prior file": Call({"source": "pca"}, lambda a: [torch.tensor(load_prior(**a).num_codes)]),
        "rig file": Call({"path": Path("none.json")}, lambda a: [rig.mean for rig in load_rigs(a["path"])]),
        "overlay": Call(
            street | {"frame": 0},
            lambda a: [torch.from_numpy(overlay(a["frames"], a["detections"], _result(), a["frame"]))],
        ),
        "mesh": Call({"index": 0}, lambda a: [torch.from_numpy(_result().mesh(a["index"]).vertices)]),
    }


@cache
def whole_call() -> tuple[FrameBatch, Detections]:
    """A call with every tensor that a call can have."""
    _, street = cached_street()
    masks = torch.zeros_like(street.detections.mask_left.dense()[:1])
    masks[0, 0, 0] = 1.0
    one = masks.new_ones(1)
    frames = replace(
        street.frames,
        disparity=torch.full_like(street.frames.images_left[:, 0], 8.0),
        points_cam=street.frames.images_left.new_ones(1, 50, 3),
    )
    occluders = Occluders(torch.zeros(1, dtype=torch.long), masks, masks, 30 * one, 50 * one)
    sigma = masks.new_full((2, 4), 0.5)
    return frames, replace(
        street.detections, occluders=occluders, pose_sigma=sigma, offset_sigma_px=masks.new_full((2,), 0.3)
    )


@cache
def _refiner(mode: str = "none") -> DirectShapeRefiner:
    return DirectShapeRefiner(cached_street()[0], load_config(None, [*QUICK, f"backward.mode={mode}"]), [LidarPoints()])


def _refine(a: Arguments) -> list[Tensor]:
    return _of_refined(_refiner()(a["frames"], a["detections"], {"silhouette_left": a["weight"]}))


def _of_refined(result: RefinementResult) -> list[Tensor]:
    boxes, used = result.boxes(), result.refined
    found = (result.T_cam_obj, result.code, result.covariance, result.sigma_xyz_yaw, result.cost_after)
    return [x[used] for x in (*found, boxes.dimensions_hwl, boxes.location_ref, boxes.rotation_y)]


def _loaded(a: Arguments) -> RefinementResult:
    return RefinementResult.from_state_dict(a, cached_street()[0])


def _gradient(a: Arguments) -> list[Tensor]:
    """Gradients by the images, the masks and the input poses, if the call was accepted."""
    wanted = [a["frames"].images_left, a["detections"].mask_left.dense(), a["detections"].T_cam_obj]
    leaves = [x.detach().clone().requires_grad_() if x.is_floating_point() else x for x in wanted]
    frames = replace(a["frames"], images_left=leaves[0])
    detections = replace(a["detections"], mask_left=leaves[1], T_cam_obj=leaves[2])
    result = _refiner("unroll")(frames, detections, {"silhouette_left": a["weight"]})
    loss = result.T_cam_obj[result.refined].sum() + result.code[result.refined].sum()
    leaves = [x for x in leaves if x.requires_grad]
    return list(torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True))


def _configured(a: Arguments) -> list[Tensor]:
    frames, detections = whole_call()
    config = load_config(None, [*QUICK, a["setting"]])
    return _of_refined(DirectShapeRefiner(cached_street()[0], config)(frames, detections))


_PRIOR_TENSORS = (
    "mean",
    "basis",
    "origin",
    "explained_variance_ratio",
    "dimensions_mean_hwl",
    "dimensions_basis_hwl",
    "dimensions_std_hwl",
)


def _prior(a: Arguments) -> list[Tensor]:
    """The result of a refinement with a prior that was accepted."""
    named = {name: a[name] for name in _PRIOR_TENSORS[3:]}
    prior = PCAShapePrior(
        *(a[name] for name in (*_PRIOR_TENSORS[:3], "spacing_m")), **named, provenance=PriorProvenance("", "", 1)
    )
    return _of_refined(DirectShapeRefiner(prior, load_config(None, QUICK))(*whole_call()))


def _rig(a: Arguments) -> list[Tensor]:
    rig = RigEstimate.of_frames(a["frames"])
    rig.update(a["frames"], a["detections"])
    rig.informed(rig.corrected(a["frames"]), a["detections"])
    return [rig.mean, rig.covariance, torch.tensor(rig.in_the_middle())]


def _rig_of_matrices(a: Arguments) -> list[Tensor]:
    rig = RigEstimate(a["size_wh"], a["K_left"], a["K_right"], a["T_right_cam"])
    return [rig.mean, rig.covariance, torch.tensor(rig.in_the_middle())]


def _rig_rows(a: Arguments) -> list[Tensor]:
    rig = RigEstimate.of_frames(whole_call()[0])
    rig.add_rows(a["rows"])
    return [rig.mean, rig.covariance]


def _field(a: Arguments) -> list[Tensor]:
    names = ("coefficients", "hull_uv", "K_left", "K_right", "T_right_cam")
    field = DisparityField(size_wh=(160, 120), **{name: a[name] for name in names})
    return list(field.offsets(a["uv"]))


def _boxes(detections: Detections) -> dict[str, Any]:
    """Every argument of `Detections.from_boxes`."""
    zeros = torch.zeros(2).double()
    boxes = torch.stack([zeros, zeros + 1, zeros + 20, zeros + 1.5, zeros + 1.6, zeros + 4, zeros + 0.3], dim=1)
    names = ("has_mask_left", "has_mask_right", "frame_index", "score", "box_2d", "pose_sigma")
    given = {name: getattr(detections, name) for name in names}
    given |= {name: getattr(detections, name).dense() for name in ("mask_left", "mask_right")}
    return {"boxes": boxes, "convention": "kitti", "track_id": torch.tensor([-1, 3]), **given}


def _from_boxes(a: Arguments) -> list[Tensor]:
    found = Detections.from_boxes(**a)
    return [found.T_cam_obj, found.dimensions_hwl]


def _fit(a: Arguments) -> list[Tensor]:
    fit = fit_shape(**a)
    return [*_of_refined(fit.cars), fit.num_points]


def _rig_state(a: Arguments) -> list[Tensor]:
    rig = RigEstimate.of_frames(whole_call()[0])
    rig.set_extra_state(a["state"])
    return [rig.mean, rig.covariance]


_FIT = {"origin": torch.zeros(3).double(), "spacing_m": 0.2, "num_codes": 2}


def _fitted_prior(a: Arguments) -> list[Tensor]:
    fitted = fit_pca(a["samples"], a["origin"], a["spacing_m"], a["num_codes"], PriorProvenance("", "", 3))
    return [fitted.mean, fitted.basis]


def _number(config: RefinerConfig) -> Tensor:
    return torch.tensor(len(str(config)))


def _projections(a: Arguments) -> list[Tensor]:
    camera = StereoCamera.from_projections(a["P_left"], a["P_right"])
    return [camera.baseline, camera.t_cam_ref, camera.T_right_cam]


@cache
def _result() -> RefinementResult:
    result: RefinementResult = _refiner()(*whole_call())
    return result


def places(record: Any, path: Place = ()) -> Iterator[Place]:
    """The fields of a record of tensors and of the records in it."""
    for each in fields(record):
        value = getattr(record, each.name)
        if isinstance(value, Tensor):
            yield (*path, each.name)
        elif is_dataclass(value):
            yield from places(value, (*path, each.name))


def at(record: Any, path: Place) -> Any:
    """The value at a place."""
    return record if not path else at(getattr(record, path[0]), path[1:])


def changed(record: Any, path: Place, value: object) -> Any:
    """The record with another value at a place, after all of its checks."""
    inner = value if len(path) == 1 else changed(getattr(record, path[0]), path[1:], value)
    return replace(record, **{path[0]: inner})


def _changed(arguments: Arguments, path: Place, value: object) -> Arguments:
    name = path[0]
    return {**arguments, name: value if len(path) == 1 else changed(arguments[name], path[1:], value)}


def _is_finite(value: object) -> bool:
    if isinstance(value, Tensor):
        if not value.dtype.is_floating_point or value.layout != torch.strided or value.device.type == "meta":
            return False
        return not value.is_nested and bool((value.detach().double().abs() < 1e12).all())
    return isinstance(value, (int, float)) and abs(value) < 1e12
