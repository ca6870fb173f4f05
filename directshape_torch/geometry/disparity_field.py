"""This module holds the residual disparity and row offset of a stereo rig, which are smooth over the left image.

Residual disparity is measured minus true disparity. Rectification leaves some tenths of a pixel (KITTI: -0.3 in the
image centre, -1.2 at its left edge). At 30 m half a pixel is 1.2 m of depth, so the residual decides whether far cars
come out right. Visual odometry knows the effect: Kreso and Segvic, "Improving the Egomotion Estimation by Correcting
the Calibration Bias", VISAPP 2015. The rows are off, too (KITTI: -0.2 to +0.3 px across the image), and on slanted
texture a row offset that is ignored looks like disparity.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_finite, check_shape, check_size_wh
from directshape_torch.numerics.conversion import as_floating
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.numerics.gradient_mode import is_plain

# These are the exponents of the normalised (u, v) in the functions 1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, u^4.
EXPONENTS: tuple[tuple[int, int], ...] = (
    (0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (4, 0),
)  # fmt: skip
NUM_COEFFICIENTS = len(EXPONENTS)

# Another frame of the same rig repeats the calibration to its printed digits or to float32 rounding; KITTI's rigs of
# different days differ by 2 px or more.
_TOLERANCE_PX = 0.05
_TOLERANCE_M = 1e-3
_TOLERANCE_ROTATION = 1e-4


@in_full_precision
def polynomial_basis(
    uv: Tensor,  # (*, 2) pixels of the left image
    size_wh: tuple[int, int],
) -> Tensor:  # (*, 10)
    """Values of the basis functions at left pixels; the image is mapped to [-1, 1] in both directions."""
    u, v = (2 * uv[..., k] / max(size_wh[k] - 1, 1) - 1 for k in range(2))
    one = torch.ones_like(u)
    u_powers, v_powers = [one, u, u * u, u * u * u, u * u * u * u], [one, v, v * v]
    return torch.stack([u_powers[i] * v_powers[j] for i, j in EXPONENTS], dim=-1)


@in_full_precision
def nearest_in_convex_polygon(
    points: Tensor,  # (*, 2)
    polygon: Tensor,  # (M, 2) vertices in order, either sense
) -> Tensor:  # (*, 2)
    """The points themselves where they lie in the polygon, else the nearest point of its border."""
    dtype = torch.promote_types(points.dtype, polygon.dtype)
    flat, polygon = points.reshape(-1, 2).to(dtype), polygon.to(dtype)
    inside = _is_inside(flat, polygon)
    if points.device.type == "cpu" and is_plain(points):
        # Few points are outside. On other devices, asking which ones would make the host wait.
        outside = (~inside).nonzero()[:, 0]
        moved = flat.index_copy(0, outside, _nearest_on_border(flat[outside], polygon))
    else:
        moved = torch.where(inside[:, None], flat, _nearest_on_border(flat, polygon))
    return moved.view(points.shape)


def _is_inside(points: Tensor, polygon: Tensor) -> Tensor:
    """Whether points (P, 2) lie in the polygon, (P,)."""
    # The edges are the first axis, so that each step runs over the memory of all points without a jump.
    (x, y), (p_x, p_y) = points.unbind(dim=1), polygon[:, None].unbind(dim=2)
    e_x, e_y = (polygon.roll(-1, dims=0) - polygon)[:, None].unbind(dim=2)
    side = e_x * (y - p_y) - e_y * (x - p_x)
    return (side >= 0).all(dim=0) | (side <= 0).all(dim=0)


def _nearest_on_border(points: Tensor, polygon: Tensor) -> Tensor:
    """The points of the polygon's border that are nearest to points (P, 2)."""
    edge = polygon.roll(-1, dims=0) - polygon
    length_squared = (edge * edge).sum(dim=-1).clamp_min(torch.finfo(points.dtype).tiny)
    along = (((points[:, None] - polygon) * edge).sum(dim=-1) / length_squared).clamp(0, 1)
    foot = polygon + along[..., None] * edge
    nearest = ((points[:, None] - foot) ** 2).sum(dim=-1).argmin(dim=-1)
    return foot.gather(1, nearest[:, None, None].expand(-1, -1, 2))[:, 0]


@dataclass(frozen=True)
class DisparityField:
    """`bias(u, v)` is measured minus true disparity in pixels, a polynomial over the left image of one rig.

    Attributes:
        coefficients: (10,) of the residual disparity in `polynomial_basis`, pixels.
        vertical_coefficients: (10,) of the measured minus predicted row in the right image, pixels.
        hull_uv: (M, 2) convex polygon around the data of the fit, pixels; points outside get the value at the nearest
            point of the polygon, because polynomials diverge.
        size_wh: width and height of the rig's images.
        K_left, K_right: (3, 3) intrinsics of the rig, pixels.
        T_right_cam: (4, 4) left to right camera, metres.
        covariance: (10, 10) covariance of the coefficients, pixels^2; 0 where they are known exactly.
    """

    coefficients: Tensor
    hull_uv: Tensor
    size_wh: tuple[int, int]
    K_left: Tensor
    K_right: Tensor
    T_right_cam: Tensor
    vertical_coefficients: Tensor = field(default_factory=lambda: torch.zeros(NUM_COEFFICIENTS))
    covariance: Tensor = field(default_factory=lambda: torch.zeros(NUM_COEFFICIENTS, NUM_COEFFICIENTS))

    def __post_init__(self) -> None:
        check_size_wh("size_wh", self.size_wh)
        for name, shape in TENSOR_SHAPES.items():
            check_shape(name, getattr(self, name), ["M" if n is None else n for n in shape], kind="floating")
            check_finite(name, getattr(self, name))
        if len(self.hull_uv) < 3:
            raise InputError("hull_uv", "shape (M, 2) with at least 3 vertices", f"{tuple(self.hull_uv.shape)}")

    @classmethod
    @in_full_precision
    def constant(
        cls,
        value_px: float,
        size_wh: tuple[int, int],
        K_left: Tensor,  # (3, 3)
        K_right: Tensor,  # (3, 3)
        T_right_cam: Tensor,  # (4, 4)
    ) -> DisparityField:
        """A field with one bias at every pixel.

        Examples:
            >>> K, T = torch.eye(3), torch.eye(4)
            >>> DisparityField.constant(-0.4, (1242, 375), K, K, T).bias(torch.tensor([[10.0, 20.0]]))
            tensor([-0.4000])
        """
        check_size_wh("size_wh", size_wh)
        K_left, K_right, T_right_cam = (as_floating(matrix) for matrix in (K_left, K_right, T_right_cam))
        check_shape("K_left", K_left, (3, 3), kind="floating")
        coefficients = torch.zeros(NUM_COEFFICIENTS, dtype=K_left.dtype, device=K_left.device)
        coefficients[0] = value_px
        right, bottom = float(size_wh[0] - 1), float(size_wh[1] - 1)
        hull_uv = K_left.new_tensor([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
        return cls(coefficients, hull_uv, size_wh, K_left, K_right, T_right_cam)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> DisparityField:
        """A copy on another device and of another floating-point type."""
        return replace(self, **{name: getattr(self, name).to(device=device, dtype=dtype) for name in TENSOR_SHAPES})

    def bias(
        self,
        uv_left: Tensor,  # (*, 2) pixels of the full-resolution left image
    ) -> Tensor:  # (*,)
        """Measured minus true disparity, pixels, in the dtype of `uv_left`; beyond the hull, as at its border."""
        return self.offsets(uv_left)[0]

    @in_full_precision
    def offsets(
        self,
        uv_left: Tensor,  # (*, 2) pixels of the full-resolution left image
    ) -> tuple[Tensor, Tensor]:  # (*,), (*,)
        """`bias`, and measured minus predicted row in the right image, pixels; beyond the hull, as at its border."""
        sizes = uv_left.shape[:-1] if isinstance(uv_left, Tensor) and not uv_left.is_nested else ()
        check_shape("uv_left", uv_left, (*sizes, 2), kind="floating")
        inside = nearest_in_convex_polygon(uv_left, self.hull_uv.to(uv_left))
        both = (self.coefficients, self.vertical_coefficients)
        coefficients = torch.stack([x.to(uv_left) for x in both], dim=1)
        bias, vertical = (polynomial_basis(inside, self.size_wh) @ coefficients).unbind(dim=-1)
        return bias, vertical

    @in_full_precision
    def sigma(
        self,
        uv_left: Tensor,  # (*, 2) pixels of the full-resolution left image
    ) -> Tensor:  # (*,)
        """Standard deviation of `bias`, pixels; it grows beyond the hull, where the fit has no data."""
        basis = polynomial_basis(uv_left, self.size_wh)
        return ((basis @ self.covariance.to(basis)) * basis).sum(dim=-1).clamp_min(0).sqrt()

    def check_rig(
        self,
        size_wh: tuple[int, int],
        K_left: Tensor,  # (3, 3)
        K_right: Tensor,  # (3, 3)
        T_right_cam: Tensor,  # (4, 4)
    ) -> None:
        """Refuse a frame of another rig.

        Raises:
            InputError: image size, intrinsics or right camera are not those that the field was fitted for.
        """
        cure = "estimate this rig with 'directshape calibrate-rig', or refine with --rig auto or none"
        if tuple(size_wh) != tuple(self.size_wh):
            expected, came = (f"{width} x {height}" for width, height in (self.size_wh, size_wh))
            raise InputError("disparity_field", f"images of {expected}", came, cure)
        for name, mine, other, tolerance, unit in (
            ("K_left", self.K_left, K_left, _TOLERANCE_PX, "px"),
            ("K_right", self.K_right, K_right, _TOLERANCE_PX, "px"),
            ("T_right_cam", self.T_right_cam, T_right_cam, _TOLERANCE_M, "m"),
            ("rotation", self.T_right_cam[:3, :3], T_right_cam[:3, :3], _TOLERANCE_ROTATION, "rad"),
        ):
            difference = float((mine.detach().double().cpu() - other.detach().double().cpu()).abs().max())
            # `not <=` refuses a calibration with NaN, too.
            if not difference <= tolerance:
                came = f"a difference of {difference:.4g} {unit}"
                raise InputError("disparity_field", f"the rig's {name} to {tolerance} {unit}", came, cure)

    @property
    def rig(self) -> tuple[tuple[int, int], Tensor, Tensor, Tensor]:
        """`size_wh`, `K_left`, `K_right`, `T_right_cam`: the arguments of `check_rig`."""
        return self.size_wh, self.K_left, self.K_right, self.T_right_cam


TENSOR_SHAPES: dict[str, tuple[int | None, ...]] = {
    "coefficients": (NUM_COEFFICIENTS,),
    "vertical_coefficients": (NUM_COEFFICIENTS,),
    "hull_uv": (None, 2),
    "K_left": (3, 3),
    "K_right": (3, 3),
    "T_right_cam": (4, 4),
    "covariance": (NUM_COEFFICIENTS, NUM_COEFFICIENTS),
}
