"""This module checks whether an object can serve as a shape prior, once, when a refiner is made."""

from __future__ import annotations

from typing import NoReturn

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.shape.shape_prior import BoundShape, DimensionsDerivative, SdfDerivatives, ShapePrior

_CURE = "see directshape_torch.shape.shape_prior for what a prior must offer"


def check_prior(prior: ShapePrior, by_autograd: bool = False) -> None:
    """Refuse a prior whose first derivatives the refinement could not use.

    Args:
        prior: any object that claims to be a `ShapePrior`.
        by_autograd: whether derivatives by autograd are needed too, besides the ones that the prior computes itself.

    Raises:
        InputError: members are missing, derivatives have a wrong shape or are not finite, or (by autograd) they do not
            reach points or code, or the prior was made in inference mode.

    Examples:
        >>> from directshape_torch.shape.pca_prior import PCAShapePrior
        >>> check_prior(PCAShapePrior.load_bundled(), by_autograd=True)
    """
    _check_members("prior", prior, ShapePrior)
    bound = prior.bind(prior.initial_code(1))
    _check_members("prior.bind(code)", bound, BoundShape)
    point = prior.bounds_obj.mean(dim=0, keepdim=True)
    index = torch.zeros(1, dtype=torch.long, device=point.device)
    at = bound.value_and_derivatives(point, index)
    sdf_shapes = {"value": (1,), "gradient": (1, 3), "J_value_code": (1, prior.num_codes)}
    _check_derivatives("value_and_derivatives", at, sdf_shapes)
    dimensions = prior.dimensions_and_derivative(prior.initial_code(1))
    _check_derivatives("dimensions_and_derivative", dimensions, {"hwl": (1, 3), "J_hwl_code": (1, 3, prior.num_codes)})
    if by_autograd:
        _check_attached(prior)


def _check_members(name: str, candidate: object, protocol: type) -> None:
    members = [name for name in vars(protocol) if not name.startswith("_")]
    missing = [member for member in members if not _has(candidate, member)]
    if missing:
        raise InputError(name, f"a {protocol.__name__}", f"{type(candidate).__name__} without {missing}", _CURE)


def _has(candidate: object, member: str) -> bool:
    """Whether a candidate has a member; its class is asked first, because an object would compute a property."""
    return hasattr(type(candidate), member) or hasattr(candidate, member)


def _check_derivatives(
    method: str, found: SdfDerivatives | DimensionsDerivative, shapes: dict[str, tuple[int, ...]]
) -> None:
    for field, shape in shapes.items():
        tensor = getattr(found, field, None)
        if not isinstance(tensor, torch.Tensor) or tuple(tensor.shape) != shape:
            got = tuple(tensor.shape) if isinstance(tensor, torch.Tensor) else tensor
            raise InputError(f"prior.{method}: {field}", f"a tensor of shape {shape} at one point", f"{got}", _CURE)
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"prior.{method}: {field}", "finite numbers", f"{tensor.tolist()}", _CURE)


def _check_attached(prior: ShapePrior) -> None:
    tensors = (*prior.named_buffers(), *prior.named_parameters())
    unrecorded = [name for name, tensor in tensors if tensor.is_inference()]
    if unrecorded:
        got = f"{', '.join(unrecorded)} from inference mode"
        raise InputError("prior", "tensors that autograd can record", got, "make it outside of torch.inference_mode()")
    with torch.inference_mode(False), torch.enable_grad():
        code = prior.initial_code(1).clone().requires_grad_()
        point = prior.bounds_obj.mean(dim=0, keepdim=True).clone().requires_grad_()
        index = torch.zeros(1, dtype=torch.long, device=point.device)
        _check_reaches("value", prior.bind(code).value(point, index), point, code)
        at = prior.bind(code).value_and_derivatives(point, index)
        _check_reaches("value_and_derivatives: value", at.value, point, code)
        elsewhere = prior.bind(code + 1).value_and_derivatives(point + prior.spacing_m, index)
    for field in ("gradient", "J_value_code"):
        # The derivatives of a linear field are the same everywhere and need no graph.
        derivative, other = getattr(at, field), getattr(elsewhere, field)
        if not derivative.requires_grad and not torch.equal(derivative, other):
            _refuse_detached(f"value_and_derivatives: {field}", "points and code")


def _check_reaches(method: str, value: Tensor, point: Tensor, code: Tensor) -> None:
    gradients: tuple[Tensor | None, ...] = (None, None)
    if value.requires_grad:
        gradients = torch.autograd.grad(value.sum(), (point, code), allow_unused=True)
    lost = [name for name, gradient in zip(("points", "code"), gradients, strict=True) if gradient is None]
    if lost:
        _refuse_detached(method, " and ".join(lost))


def _refuse_detached(method: str, lost: str) -> NoReturn:
    raise InputError(
        f"prior.bind(code).{method}",
        "a graph from points and code to it, as jacobian='autograd' and the backward modes need it",
        f"none from {lost}",
        "compute it with differentiable operations, or use jacobian='analytic' and backward.mode='none'",
    )
