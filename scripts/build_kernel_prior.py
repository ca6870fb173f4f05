"""Make a kernel PCA shape prior from parametric cars, the same cars as in the bundled PCA prior.

    python scripts/build_kernel_prior.py --out kernel_prior.safetensors [--num-cars 600 --num-codes 8]

It is not bundled: 32 components of grids weigh 3 MB, and its results are no better (docs/results.md).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from build_bundled_prior import GRID, sample_grid
from tqdm import tqdm

from directshape_torch.shape.kernel_pca_prior import KernelPCAShapePrior
from directshape_torch.shape.pca_prior import PriorProvenance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-cars", type=int, default=600)
    parser.add_argument("--num-codes", type=int, default=8)
    parser.add_argument("--num-components", type=int, default=32)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    samples = [torch.from_numpy(sample_grid(seed)) for seed in tqdm(range(args.num_cars), desc="cars", unit="car")]
    provenance = PriorProvenance(
        made_by="scripts/build_kernel_prior.py of directshape_torch, from parametric cars with seeds from 0",
        licence="Apache-2.0",
        num_samples=args.num_cars,
    )
    prior = KernelPCAShapePrior.fit(
        torch.stack(samples),
        torch.tensor(GRID.origin, dtype=torch.float32),
        GRID.spacing_m,
        args.num_codes,
        provenance,
        num_components=args.num_components,
    )
    prior.save(args.out)
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
