"""Make `directshape_torch/assets/car_prior.npz`: principal components of a few hundred parametric cars.

    python scripts/build_bundled_prior.py [--num-cars 600 --num-codes 8 --out PATH]

No mesh, picture or measurement of a real car goes in: every car comes from `directshape_torch.shape.parametric_cars`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from directshape_torch.shape.parametric_cars import car_sdf, sample_car
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance

SPACING_M = 0.1
# Room for a car 5.2 m long, 2.0 m high and 2.0 m wide with 0.2 m or more around it, below the ground too.
ORIGIN = np.array([-2.9, -2.2, -1.3])
GRID_SHAPE = (59, 26, 27)


def grid_nodes() -> NDArray[np.float64]:
    """Positions of the grid's nodes in the object frame, (nx, ny, nz, 3), metres."""
    axes = [ORIGIN[k] + SPACING_M * np.arange(GRID_SHAPE[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def sample_grid(seed: int) -> NDArray[np.float32]:
    """Signed distance grid of the car with this seed; one half is computed and mirrored."""
    half = grid_nodes()[:, :, GRID_SHAPE[2] // 2 :]
    distance = car_sdf(sample_car(seed), half.reshape(-1, 3)).reshape(half.shape[:-1])
    return np.concatenate([distance[:, :, :0:-1], distance], axis=2).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-cars", type=int, default=600)
    parser.add_argument("--num-codes", type=int, default=8)
    default = Path(__file__).parents[1] / "directshape_torch" / "assets" / "car_prior.npz"
    parser.add_argument("--out", type=Path, default=default)
    args = parser.parse_args()
    samples = np.stack([sample_grid(seed) for seed in tqdm(range(args.num_cars), desc="cars", unit="car")])
    provenance = PriorProvenance(
        made_by="scripts/build_bundled_prior.py of directshape_torch, from parametric cars with seeds from 0",
        licence="Apache-2.0",
        num_samples=args.num_cars,
    )
    origin = torch.from_numpy(ORIGIN.astype(np.float32))
    prior = PCAShapePrior.fit(torch.from_numpy(samples), origin, SPACING_M, args.num_codes, provenance)
    prior.save(args.out, grid_dtype="float16")
    shares = ", ".join(f"{share:.3f}" for share in prior.explained_variance_ratio.tolist())
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB, explained variance {shares}")


if __name__ == "__main__":
    main()
