"""This module has the measures of a parametric passenger car and their variation in each body type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from directshape_torch.errors import InputError


@dataclass(frozen=True)
class CarParameters:
    """A `CarParameters` has measures of one car; `*_u` are distances behind the front, `*_height` above ground."""

    body_type: str  # one of `BODY_TYPES`
    length: float  # outer measures in metres, without mirrors
    width: float
    height: float
    ground_clearance: float  # of the underbody between the axles
    bumper_clearance_front: float  # height of the lower edge of the bumpers
    bumper_clearance_rear: float
    wheelbase: float
    front_axle_u: float
    wheel_radius: float  # of the tyres
    wheel_width: float
    nose_height: float  # of the bonnet's leading edge
    nose_setback: float  # distance of that edge behind the bumper
    bonnet_bulge: float  # height of the bonnet's arc over its chord
    cowl_u: float  # foot of the windscreen
    cowl_height: float
    roof_front_u: float  # top of the windscreen
    roof_front_drop: float  # distance below the roof's highest point
    roof_peak_u: float  # highest point of the roof
    roof_rear_u: float  # rear end of the roof
    roof_rear_drop: float  # distance below the highest point
    rear_glass_base_u: float  # foot of the rear window
    rear_glass_base_height: float
    tail_height: float  # upper rear edge of the boot or tailgate
    tail_setback: float  # distance from the rear end
    belt_height: float  # lower edge of the side windows
    tumblehome: float  # inward lean of the side windows, metres per metre of height
    sill_tuck: float  # inward shift of the body sides from the belt to the sill
    taper_front: float  # share of the half width that the plan view loses towards the ends
    taper_rear: float
    bow_front: float  # distance of the corners behind the middle of the bumper, plan view
    bow_rear: float
    roof_crown: float  # fall of roof and bonnet from the middle towards the sides
    edge_radius: float  # of the edges between the sides and roof, bonnet and ends


# Columns of the table have mean and standard deviation, except `share` and `clearance`. Positions are shares of the
# length; heights are shares of the height, except that the drop is in metres.
_COLUMNS = (
    "share", "length", "width", "height", "clearance", "front_axle", "wheelbase", "wheel_radius", "nose_height", "cowl",
    "cowl_height", "roof_front", "roof_rear", "roof_rear_drop", "rear_glass_base", "rear_glass_base_height",
    "tail_height", "tumblehome",
)  # fmt: skip
# These are typical measures of each class of passenger cars, not of single models, adjusted by hand to how the
# resulting prior fits real cars. The shares give the mixture the length, width and height of KITTI's labelled cars
# (3.88, 1.63, 1.53 m).
_STATISTICS: Mapping[str, tuple[Any, ...]] = {
    "city": (
        0.16, (3.28, 0.14), (1.49, 0.09), (1.47, 0.05), 0.19,
        (0.200, 0.012), (0.665, 0.020), (0.280, 0.012), (0.52, 0.04),
        (0.235, 0.035), (0.675, 0.03), (0.455, 0.03), (0.875, 0.03), (0.04, 0.025),
        (0.965, 0.012), (0.64, 0.04), (0.58, 0.06), (0.36, 0.08),
    ),
    "hatchback": (
        0.28, (3.72, 0.19), (1.60, 0.07), (1.47, 0.06), 0.19,
        (0.205, 0.012), (0.640, 0.018), (0.298, 0.014), (0.51, 0.04),
        (0.280, 0.025), (0.665, 0.025), (0.470, 0.025), (0.860, 0.04), (0.05, 0.03),
        (0.950, 0.020), (0.65, 0.04), (0.60, 0.06), (0.42, 0.08),
    ),
    "saloon": (
        0.12, (4.24, 0.23), (1.66, 0.07), (1.43, 0.05), 0.18,
        (0.195, 0.012), (0.595, 0.018), (0.310, 0.014), (0.51, 0.04),
        (0.300, 0.025), (0.665, 0.025), (0.445, 0.025), (0.705, 0.030), (0.035, 0.02),
        (0.835, 0.025), (0.71, 0.03), (0.68, 0.03), (0.46, 0.08),
    ),
    "estate": (
        0.10, (4.25, 0.21), (1.66, 0.07), (1.47, 0.05), 0.18,
        (0.195, 0.012), (0.595, 0.018), (0.310, 0.014), (0.50, 0.04),
        (0.290, 0.025), (0.655, 0.025), (0.450, 0.025), (0.915, 0.025), (0.04, 0.025),
        (0.965, 0.012), (0.64, 0.04), (0.58, 0.06), (0.42, 0.08),
    ),
    "suv": (
        0.11, (4.00, 0.30), (1.72, 0.08), (1.69, 0.07), 0.25,
        (0.195, 0.012), (0.605, 0.015), (0.350, 0.018), (0.57, 0.04),
        (0.270, 0.025), (0.665, 0.020), (0.430, 0.025), (0.915, 0.03), (0.04, 0.025),
        (0.970, 0.012), (0.64, 0.04), (0.59, 0.05), (0.30, 0.08),
    ),
    "van": (
        0.15, (3.80, 0.40), (1.68, 0.08), (1.76, 0.09), 0.20,
        (0.200, 0.012), (0.635, 0.020), (0.310, 0.014), (0.50, 0.04),
        (0.195, 0.045), (0.610, 0.030), (0.400, 0.03), (0.940, 0.025), (0.035, 0.02),
        (0.975, 0.010), (0.60, 0.04), (0.53, 0.05), (0.21, 0.08),
    ),
    "coupe": (
        0.06, (3.98, 0.23), (1.65, 0.07), (1.33, 0.05), 0.16,
        (0.200, 0.012), (0.600, 0.018), (0.305, 0.014), (0.52, 0.04),
        (0.330, 0.025), (0.670, 0.025), (0.475, 0.025), (0.670, 0.035), (0.035, 0.02),
        (0.855, 0.035), (0.71, 0.04), (0.67, 0.04), (0.50, 0.08),
    ),
    "pickup": (
        0.02, (4.90, 0.20), (1.75, 0.06), (1.72, 0.06), 0.24,
        (0.180, 0.012), (0.610, 0.015), (0.350, 0.018), (0.56, 0.04),
        (0.270, 0.020), (0.640, 0.020), (0.395, 0.020), (0.620, 0.030), (0.035, 0.02),
        (0.665, 0.025), (0.60, 0.02), (0.60, 0.02), (0.36, 0.08),
    ),
}  # fmt: skip

BODY_TYPES: tuple[str, ...] = tuple(_STATISTICS)


def sample_car(seed: int | np.random.Generator, body_type: str | None = None) -> CarParameters:
    """Draw a car; equal seeds give equal cars.

    Args:
        seed: integer, or a numpy generator to draw from.
        body_type: one of `BODY_TYPES`; None draws one by its share of the traffic.

    Raises:
        InputError: the body type is unknown.
    """
    rng = np.random.default_rng(seed)
    if body_type is None:
        shares = np.array([row[0] for row in _STATISTICS.values()])
        body_type = str(rng.choice(BODY_TYPES, p=shares / shares.sum()))
    if body_type not in _STATISTICS:
        raise InputError("body_type", f"one of {', '.join(BODY_TYPES)}", repr(body_type))
    return _draw(rng, body_type, dict(zip(_COLUMNS, _STATISTICS[body_type], strict=True)))


def _draw(rng: np.random.Generator, body_type: str, statistics: Mapping[str, Any]) -> CarParameters:
    def draw(name: str) -> float:
        mean, deviation = statistics[name]
        # Values are cut at two deviations, because a rare extreme car would distort the principal components.
        return float(mean + deviation * np.clip(rng.standard_normal(), -2.0, 2.0))

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    length, width, height = draw("length"), draw("width"), draw("height")
    cowl_height = height * draw("cowl_height")
    roof_front, roof_rear = draw("roof_front"), draw("roof_rear")
    rear_glass_base_height = height * draw("rear_glass_base_height")
    clearance = statistics["clearance"] + uniform(-0.04, 0.06)
    return CarParameters(
        body_type=body_type,
        length=length,
        width=width,
        height=height,
        ground_clearance=clearance,
        bumper_clearance_front=clearance + uniform(-0.02, 0.08),
        bumper_clearance_rear=clearance + uniform(0.03, 0.20),
        wheelbase=length * draw("wheelbase"),
        front_axle_u=length * draw("front_axle"),
        wheel_radius=draw("wheel_radius"),
        wheel_width=uniform(0.17, 0.23),
        nose_height=height * draw("nose_height"),
        nose_setback=uniform(0.06, 0.20),
        bonnet_bulge=uniform(0.01, 0.06),
        cowl_u=length * draw("cowl"),
        cowl_height=cowl_height,
        roof_front_u=length * roof_front,
        roof_front_drop=uniform(0.01, 0.07) * (roof_rear - roof_front) / 0.4,
        roof_peak_u=length * (roof_front + uniform(0.2, 0.7) * (roof_rear - roof_front)),
        roof_rear_u=length * roof_rear,
        roof_rear_drop=max(draw("roof_rear_drop"), 0.01),
        rear_glass_base_u=length * draw("rear_glass_base"),
        rear_glass_base_height=rear_glass_base_height,
        tail_height=min(height * draw("tail_height"), rear_glass_base_height),
        tail_setback=uniform(0.03, 0.16),
        belt_height=cowl_height + uniform(-0.06, 0.03),
        tumblehome=max(draw("tumblehome"), 0.08),
        sill_tuck=uniform(0.02, 0.09),
        taper_front=uniform(0.03, 0.16),
        taper_rear=uniform(0.02, 0.18),
        bow_front=uniform(0.10, 0.32),
        bow_rear=uniform(0.06, 0.26),
        roof_crown=uniform(0.0, 0.06) * (0.35 if body_type in ("van", "suv") else 1.0),
        edge_radius=uniform(0.02, 0.08),
    )
