"""Judge a shape prior on real car meshes that were not used to make it.

    DIRECTSHAPE_DATA=... python scripts/judge_prior.py [--prior PATH] [--codes 1 3 5 8]

For each mesh: signed distance grid (left-right symmetric) at the prior's own nodes; the code alone is fitted by plain
least squares, without regularisation, to the nodes whose true distance is at most 7 cm; the figure is the mean
|reconstructed - true| distance over the same nodes, in centimetres.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_quality import NEAR_SURFACE_M, fit_code

# Not ordinary cars: two pick-ups, an off-roader with a spare wheel, a racing car, an oversized SUV, the Beetle.
LEFT_OUT = {"gazebo/pickup", "comrade1280/pickup", "comrade1280/offroad", "comrade1280/sport", "gazebo/suv"} | {
    "pgdrive/beetle_ccby"
}


def ordinary_cars(meshes: Path) -> dict[str, Path]:
    """Mesh files of the judged cars, by folder/name."""
    files = sorted([*meshes.glob("*/*.obj"), *meshes.glob("*/*.glb")])
    named = {f"{file.parent.name}/{file.stem}": file for file in files}
    return {name: file for name, file in named.items() if name not in LEFT_OUT}


def true_sdf(file: Path, grid: GridSpec) -> NDArray[np.float32]:
    """Signed distances of a mesh at the nodes of a grid, (nx, ny, nz), metres."""
    options = MeshOptions(forward_axis="+z", up_axis="+y") if file.suffix == ".glb" else MeshOptions()
    return mesh_to_sdf(load_mesh_obj(file, options), grid, options, file.name)


def fit_error_cm(prior: PCAShapePrior, sdf: Tensor, num_codes: int) -> tuple[float, Tensor]:
    """Mean |error| in cm near the true surface after fitting the first codes by least squares, and the code."""
    if num_codes == 0:
        near = sdf.abs() <= NEAR_SURFACE_M
        return 100 * float((sdf - prior.mean)[near].abs().mean()), torch.zeros(0)
    fit = fit_code(prior.with_num_codes(num_codes), sdf)
    return fit.mean_error_cm, fit.code


def main() -> None:
    """Judge the prior and print a line for each mesh."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", type=Path, help="npz file; the bundled prior if left out")
    parser.add_argument("--codes", type=int, nargs="*", default=[0, 1, 2, 3, 5, 8, 10])
    args = parser.parse_args()
    root = os.environ.get("DIRECTSHAPE_DATA")
    if root is None:
        parser.error("set DIRECTSHAPE_DATA to the folder that holds meshes/")
    prior = PCAShapePrior.load(args.prior) if args.prior else PCAShapePrior.load_bundled()
    counts = [k for k in args.codes if k <= prior.num_codes]
    x, y, z = prior.origin.tolist()
    nx, ny, nz = prior.mean.shape
    grid = GridSpec((x, y, z), prior.spacing_m, (nx, ny, nz))
    print(f"{'mean |error| within 7 cm, cm':32s}" + "".join(f"   K={k:<3d}" for k in counts) + "  |code|")
    table = []
    for name, file in ordinary_cars(Path(root) / "meshes").items():
        sdf = torch.from_numpy(true_sdf(file, grid))
        fits = [fit_error_cm(prior, sdf, k) for k in counts]
        table.append([error for error, _ in fits])
        print(f"{name:32s}" + "".join(f"{error:8.2f}" for error in table[-1]) + f"{fits[-1][1].norm():8.1f}")
    print(f"{'mean':32s}" + "".join(f"{error:8.2f}" for error in np.mean(table, axis=0)))


if __name__ == "__main__":
    main()
