"""This script trains `directshape_torch/assets/neural_prior.safetensors`, a small network as shape prior.

    python scripts/train_neural_prior.py [--num-cars 600 --num-codes 8 --steps 6000 --seed 0 --out PATH]

Every car comes from `parametric_cars`, with the same seeds (from 0) as in the bundled PCA prior; no meshes are used.
The network is an auto-decoder: the codes of the training cars start at their whitened principal components and are
learned with the weights; at the end they are whitened again, and the map for it is folded into the weights. On one idle
core the cars take three minutes and the weights two. Equal seeds give equal bytes on the same machine.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from build_bundled_prior import GRID, sample_grid
from numpy.typing import NDArray
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_mesh, car_sdf
from torch import Tensor
from tqdm import tqdm

from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_fit import training_codes
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.shape.zero_level import zero_level_extents

Array = NDArray[np.float64]

NEAR_POINTS, FAR_POINTS = 6000, 3000
FIRST_POINT_SEED = 10_000_000
NEAR_SPREADS_M = (0.01, 0.03, 0.1)
# Points are weighted by their distance to the surface, like the nodes in the PCA prior, because refinement uses the
# zero level.
SURFACE_BAND_M, FAR_WEIGHT = 0.15, 0.05
CARS_PER_STEP, POINTS_PER_CAR = 128, 64
CODE_PENALTY, RATE = 1e-4, 3e-3


@dataclass(frozen=True)
class TrainingCars:
    """A `TrainingCars` has signed distances of N cars at random points and on the grid of the PCA prior."""

    points: Tensor  # (N, P, 3) metres
    sdf: Tensor  # (N, P) metres
    grids: Tensor  # (N, nx, ny, nz) metres


def sample_points(seed: int) -> tuple[Array, Array]:
    """Points near the surface and in the bounds of the car with this seed, and their signed distances."""
    rng = np.random.default_rng(FIRST_POINT_SEED + seed)
    car = sample_car(seed)
    vertices = np.asarray(car_mesh(car, 0.04).vertices)
    half = vertices[vertices[:, 2] >= -1e-6]  # the network is symmetric by construction
    near = half[rng.integers(len(half), size=NEAR_POINTS)]
    noise = rng.normal(size=(NEAR_POINTS, 3))
    near = near + noise * rng.choice(NEAR_SPREADS_M, size=(NEAR_POINTS, 1))
    lower, upper = GRID.nodes()[0, 0, 0], GRID.nodes()[-1, -1, -1]
    points = np.concatenate([near, rng.uniform(lower, upper, size=(FAR_POINTS, 3))]).clip(lower, upper)
    return points, car_sdf(car, points)


def make_cars(num_cars: int) -> TrainingCars:
    """The cars with seeds from 0."""
    cars = [(*sample_points(seed), sample_grid(seed)) for seed in tqdm(range(num_cars), desc="cars", unit="car")]
    return TrainingCars(*(torch.from_numpy(np.stack(part).astype(np.float32)) for part in zip(*cars, strict=True)))


def train(
    cars: TrainingCars, prior: NeuralShapePrior, code: Tensor, num_steps: int, generator: torch.Generator
) -> Tensor:
    """Train the prior in place; return the learned codes (N, K)."""
    code = code.clone().requires_grad_()
    optimiser = torch.optim.Adam([*prior.parameters(), code], lr=RATE)
    progress = tqdm(range(num_steps), desc="steps", unit="step")
    for step in progress:
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, step / 100) * 0.5 * (1 + math.cos(math.pi * step / num_steps))
        loss = _loss(cars, prior, code, generator)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 500 == 0:
            progress.set_postfix(cm=f"{100 * float(loss.detach()):.2f}")
    return code.detach()


def _loss(cars: TrainingCars, prior: NeuralShapePrior, code: Tensor, generator: torch.Generator) -> Tensor:
    """Mean |predicted - true| distance, weighted towards the surface, metres."""
    rows = torch.randint(len(cars.sdf), (CARS_PER_STEP,), generator=generator)
    columns = torch.randint(cars.sdf.shape[1], (CARS_PER_STEP, POINTS_PER_CAR), generator=generator)
    points, truth = cars.points[rows[:, None], columns], cars.sdf[rows[:, None], columns].flatten()
    owner = torch.arange(CARS_PER_STEP).repeat_interleave(POINTS_PER_CAR)
    predicted = prior.bind(code[rows]).value(points.reshape(-1, 3), owner)
    weight = torch.exp(-((truth / SURFACE_BAND_M) ** 2)) + FAR_WEIGHT
    return (weight * (predicted - truth).abs()).sum() / weight.sum() + CODE_PENALTY * (code[rows] ** 2).mean()


@torch.no_grad()
def whiten(prior: NeuralShapePrior, code: Tensor) -> Tensor:
    """Fold `code = mean + white @ factor.T` into the weights; return the white codes (N, K)."""
    mean, covariance = code.mean(0), code.T.cov()
    factor = torch.linalg.cholesky(covariance)
    for layer in prior.coded_layers():
        layer.bias += layer.code_weight @ mean
        layer.code_weight.copy_(layer.code_weight @ factor)
    return torch.linalg.solve_triangular(factor, (code - mean).T, upper=False).T


@torch.no_grad()
def fit_dimensions(prior: NeuralShapePrior, code: Tensor, grids: Tensor) -> Tensor:
    """Fit the prior's quadratic map from white codes (N, K) to height, width and length; return residuals (N, 3)."""
    extents = zero_level_extents(grids.double(), torch.tensor(GRID.origin).double(), GRID.spacing_m)
    dimensions = (extents[:, 1] - extents[:, 0])[:, [1, 2, 0]]
    z, num_codes = code.double(), code.shape[1]
    i, j = torch.triu_indices(num_codes, num_codes)
    design = torch.cat([torch.ones_like(z[:, :1]), z, z[:, i] * z[:, j]], dim=1)
    solution = torch.linalg.lstsq(design, dimensions).solution
    quadratic = z.new_zeros(3, num_codes, num_codes)
    quadratic[:, i, j] = solution[1 + num_codes :].T
    prior.dimensions_mean_hwl.copy_(solution[0])
    prior.dimensions_linear_hwl.copy_(solution[1 : 1 + num_codes].T)
    prior.dimensions_quadratic_hwl.copy_(0.5 * (quadratic + quadratic.transpose(1, 2)))
    return dimensions - prior.dimensions_and_derivative(code).hwl


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-cars", type=int, default=600)
    parser.add_argument("--num-codes", type=int, default=8)
    parser.add_argument("--layer-widths", type=int, nargs="+", default=[64, 64, 64])
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    default = Path(__file__).parents[1] / "directshape_torch" / "assets" / "neural_prior.safetensors"
    parser.add_argument("--out", type=Path, default=default)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    cars = make_cars(args.num_cars)
    provenance = PriorProvenance(
        made_by="scripts/train_neural_prior.py of directshape_torch, from parametric cars with seeds from 0",
        licence="Apache-2.0",
        num_samples=args.num_cars,
        remarks=f"seed {args.seed}, {args.steps} steps, auto-decoder from whitened principal components",
    )
    origin = torch.tensor(GRID.origin, dtype=torch.float32)
    prior = NeuralShapePrior(args.layer_widths, args.num_codes, origin, GRID.shape, GRID.spacing_m, provenance)
    prior.requires_grad_()
    start = training_codes(cars.grids, args.num_codes).float()
    code = train(cars, prior, start, args.steps, torch.Generator().manual_seed(args.seed))
    prior.requires_grad_(False)
    residual = fit_dimensions(prior, whiten(prior, code), cars.grids)
    prior.save(args.out)
    std_cm = ", ".join(f"{100 * std:.1f}" for std in residual.std(dim=0).tolist())
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB; height, width, length of the code within {std_cm} cm")


if __name__ == "__main__":
    main()
