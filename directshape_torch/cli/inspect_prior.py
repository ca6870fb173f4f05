"""The part of `directshape inspect` that draws a shape prior."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from directshape_torch.cli.build_prior import find_meshes
from directshape_torch.errors import DataFormatError, InputError, MeshError
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.mesh_to_sdf import MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.parametric_cars import BODY_TYPES, car_sdf, sample_car
from directshape_torch.shape.prior_quality import FittedCar, fit_car, grid_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.inspection.prior_figures import (
    write_code_animation,
    write_code_figure,
    write_fit_figure,
)

# The bundled prior is made of the generator's cars with seeds from 0 to 599.
_UNSEEN_SEED = 100_000


def inspect_prior(name: str, meshes: Path | None, options: MeshOptions, out_dir: Path) -> int:
    """Draw what the codes of a prior do, and known cars that it is fitted to; returns the exit code.

    Args:
        name: of a bundled prior, or a file.
        meshes: folder of real cars; None: cars of the bundled generator that are not in the bundled prior.
        options: how the meshes are to be read.
        out_dir: made where it is missing.

    Raises:
        DataFormatError: the prior cannot be read.
        InputError: no meshes that could be used.
    """
    prior = load_prior(name)
    cars = _generated_cars(prior) if meshes is None else _real_cars(prior, meshes, options)
    write_fit_figure(out_dir / "fits.png", prior, cars)
    write_code_figure(out_dir / "codes.png", prior)
    write_code_animation(out_dir / "codes.gif", prior)
    for car in cars:
        print(f"{car.name}: {car.error_cm:.2f} cm, code {' '.join(f'{c:+.2f}' for c in car.code.tolist())}")
    print(f"mean of {len(cars)} cars: {sum(car.error_cm for car in cars) / len(cars):.2f} cm near the surface")
    print(f"figures  {out_dir}")
    return 0


def _generated_cars(prior: ShapePrior) -> list[FittedCar]:
    """One car of each body type."""
    nodes = grid_of(prior).nodes()
    fitted = []
    for number, body_type in enumerate(tqdm(BODY_TYPES, unit="car", desc="cars", file=sys.stderr)):
        distance = car_sdf(sample_car(_UNSEEN_SEED + number, body_type), nodes.reshape(-1, 3))
        truth = torch.from_numpy(distance.reshape(nodes.shape[:-1]).astype(np.float32))
        fitted.append(fit_car(prior, truth, body_type))
    return fitted


def _real_cars(prior: ShapePrior, folder: Path, options: MeshOptions) -> list[FittedCar]:
    """The cars of all meshes that can be made solid; the others are named on stderr."""
    grid, fitted = grid_of(prior), []
    for file in tqdm(find_meshes(folder, "**/*"), unit="mesh", desc="meshes", file=sys.stderr):
        name = str(file.relative_to(folder).with_suffix(""))
        try:
            truth = torch.from_numpy(mesh_to_sdf(load_mesh_obj(file, options), grid, options, name))
        except (DataFormatError, MeshError) as problem:
            print(f"skipped: {problem}", file=sys.stderr)
            continue
        fitted.append(fit_car(prior, truth, name))
    if not fitted:
        raise InputError("--meshes", "at least one mesh that can be made solid", f"none in {folder}")
    return fitted
