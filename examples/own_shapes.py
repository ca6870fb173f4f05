"""A shape prior from meshes, checked, and the bundled frame refined with it.

    python examples/own_shapes.py [--out DIR] [--meshes DIR]

Without `--meshes` a dozen are made of the bundled shapes. Forty or more real ones are better;
`directshape build-prior` does the same from the command line and says what each mesh lacked.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import directshape_torch
from directshape_torch import DirectShapeRefiner, PCAShapePrior, RefinementResult
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.pca_fit import fit_pca
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.shape.zero_level import sdf_to_mesh

ROOT = Path(directshape_torch.__file__).parent / "assets" / "demo"


def make_meshes(folder: Path, count: int = 12) -> None:
    """Cars in the object frame: x forward, y down, the ground at y = 0, metres."""
    folder.mkdir(parents=True, exist_ok=True)
    prior = PCAShapePrior.load_bundled()
    codes = torch.randn(count, prior.num_codes, generator=torch.Generator().manual_seed(0))
    for number, values in enumerate(prior.values(codes)):
        sdf_to_mesh(values, prior.origin, prior.spacing_m).export(folder / f"car_{number:03d}.ply")


def build(meshes: Path, num_codes: int = 4) -> PCAShapePrior:
    """Principal components of the signed distance grids of all meshes of a folder."""
    grid = GridSpec.for_cars(spacing_m=0.1)
    options = MeshOptions(forward_axis="+x", up_axis="-y", voxel_m=0.05)  # of the files; coarse voxels, for speed
    sdfs = np.stack([mesh_to_sdf(load_mesh_obj(path, options), grid, options) for path in sorted(meshes.glob("*.ply"))])
    made = PriorProvenance("examples/own_shapes.py", "that of the meshes", len(sdfs))
    return fit_pca(torch.from_numpy(sdfs).float(), torch.tensor(grid.origin), grid.spacing_m, num_codes, made)


def main(out_dir: Path, meshes: Path | None = None) -> RefinementResult:
    """Build, save, load again, refine."""
    if meshes is None:
        meshes = out_dir / "meshes"
        make_meshes(meshes)
    prior = build(meshes)
    shares = ", ".join(f"{share:.0%}" for share in prior.explained_variance_ratio.tolist())
    print(f"{prior.provenance.num_samples} meshes, variance explained by each component: {shares}")
    prior.save(out_dir / "own_prior.safetensors")

    dataset = open_dataset("kitti", ROOT, ROOT / "detections" / "noisy_stereo", ROOT / "training" / "masks")
    loaded = dataset.load("000000")
    result = DirectShapeRefiner(prior=load_prior(out_dir / "own_prior.safetensors"))(loaded.frame, loaded.detections)
    for car, status in enumerate(result.status):
        print(f"car {car}: {status.name}, code {', '.join(f'{z:+.1f}' for z in result.code[car].tolist())}")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("own_shapes_out"))
    parser.add_argument("--meshes", type=Path)
    args = parser.parse_args()
    main(args.out, args.meshes)
