"""This script makes `directshape_torch/assets/car_prior.safetensors` from a few hundred parametric cars.

    python scripts/build_bundled_prior.py [--num-cars 600 --num-codes 8 --out PATH]

The prior has the principal components of cars from `parametric_cars` and uses no meshes. The ranges of their measures
were adjusted by hand to how the prior fits real car meshes.
"""

from __future__ import annotations

import argparse
from multiprocessing import Pool
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from parametric_cars.measures import sample_car
from parametric_cars.surfaces import car_sdf
from tqdm import tqdm

from directshape_torch.shape.mesh_to_sdf import GridSpec
from directshape_torch.shape.pca_fit import fit_pca
from directshape_torch.shape.prior_file import PriorProvenance

GRID = GridSpec.for_cars(spacing_m=0.1)


def sample_grid(seed: int) -> NDArray[np.float32]:
    """Signed distance grid of the car with this seed; one half is computed and mirrored."""
    half = GRID.nodes()[:, :, GRID.shape[2] // 2 :]
    distance = car_sdf(sample_car(seed), half.reshape(-1, 3)).reshape(half.shape[:-1])
    return np.concatenate([distance[:, :, :0:-1], distance], axis=2).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-cars", type=int, default=600)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--num-codes", type=int, default=8)
    bundled = Path(__file__).parents[1] / "directshape_torch" / "assets" / "car_prior.safetensors"
    parser.add_argument("--out", type=Path, default=bundled)
    args = parser.parse_args()
    with Pool(args.processes) as pool:
        grids = pool.imap(sample_grid, range(args.num_cars))
        samples = torch.from_numpy(np.stack(list(tqdm(grids, total=args.num_cars, desc="cars", unit="car"))))
    provenance = PriorProvenance(
        made_by="scripts/build_bundled_prior.py of directshape_torch, from parametric cars with seeds from 0",
        licence="Apache-2.0",
        num_samples=args.num_cars,
    )
    prior = fit_pca(samples, torch.tensor(GRID.origin), GRID.spacing_m, args.num_codes, provenance)
    prior.save(args.out, torch.float16)
    mean, std = prior.dimensions_mean_hwl.tolist(), prior.dimensions_std_hwl.tolist()
    print("height, width, length, m: " + ", ".join(f"{m:.2f} +- {s:.2f}" for m, s in zip(mean, std, strict=True)))
    shares = ", ".join(f"{share:.3f}" for share in prior.explained_variance_ratio.tolist())
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB, explained variance {shares}")


if __name__ == "__main__":
    main()
