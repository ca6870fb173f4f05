"""`directshape build-prior`: make a shape prior from a folder of car meshes.

Meshes that do not look like cars by the given axes and scale are skipped. The others are made solid, their signed
distance is sampled, and the principal components are kept. The command writes the prior and a report (.json) beside it.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from directshape_torch.errors import DataFormatError, InputError, MeshError, UnlikelyMeshError
from directshape_torch.files import atomic_files
from directshape_torch.files.mesh_files import MESH_SUFFIXES
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.shape.pca_fit import fit_pca, leave_one_out_errors_cm
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance

REPORT_SCHEMA = "directshape_torch.prior_report/1"
# No vehicle or person is larger than this.
_LARGEST_M = 30.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of meshes, grid and components."""
    parser.add_argument(
        "--meshes", type=Path, required=True, help="folder of obj, ply, glb, off or stl files, searched deep"
    )
    parser.add_argument("--out", type=Path, required=True, help="safetensors file to write")
    parser.add_argument("--pattern", default="**/*", help="which files below the folder (default: %(default)s)")
    parser.add_argument("--num-codes", type=int, default=8, help="components to keep (default: %(default)s)")
    parser.add_argument("--spacing", type=float, default=0.1, metavar="M", help="grid spacing (default: %(default)s)")
    parser.add_argument(
        "--forward-axis", default="+x", help="the files' axis to the front, as --forward-axis=-x (default: %(default)s)"
    )
    parser.add_argument(
        "--up-axis", default="+z", help="the files' axis upwards, as --up-axis=-y (default: %(default)s)"
    )
    parser.add_argument("--scale", type=float, default=1.0, help="metres per unit of the files (default: %(default)s)")
    parser.add_argument("--length", type=float, metavar="M", help="scale every car to this length")
    parser.add_argument(
        "--not-cars",
        action="store_true",
        help="the meshes are of another class (trucks, people): do not compare them with cars",
    )
    parser.add_argument("--closing", type=float, default=0.2, metavar="M", help="closes gaps up to twice this wide")
    parser.add_argument("--voxel", type=float, default=0.025, metavar="M", help="fine voxels (default: %(default)s)")
    parser.add_argument("--no-symmetry", action="store_true", help="do not average left and right")
    parser.add_argument("--licence", default="as the meshes", help="kept inside the prior (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Build the prior; return 0 if all meshes were used, 3 if some were skipped."""
    if not 0.02 <= args.spacing <= 0.5:
        raise InputError("--spacing", "0.02 to 0.5 m", f"{args.spacing}")
    if args.num_codes < 1:
        raise InputError("--num-codes", "at least 1", f"{args.num_codes}")
    if args.out.suffix == ".json":
        raise InputError("--out", "another ending than .json, which is that of the report", str(args.out))
    atomic_files.check_file("--out", args.out)
    options = MeshOptions(
        args.forward_axis,
        args.up_axis,
        args.scale,
        args.length,
        symmetrise=not args.no_symmetry,
        voxel_m=args.voxel,
        closing_m=args.closing,
        are_cars=not args.not_cars,
    )
    files = _find_meshes(args.meshes, args.pattern)
    _check_enough(len(files), {}, args.num_codes)
    grid = GridSpec.for_cars(args.spacing) if options.are_cars else _grid_around(files, args.spacing, options)
    grids, skipped = _read_meshes(files, args.meshes, grid, options)
    _check_enough(len(grids), skipped, args.num_codes)
    samples = torch.stack(list(grids.values()))
    made_by, names = "directshape build-prior", ", ".join(grids)
    provenance = PriorProvenance(made_by, args.licence, len(grids), names, of_cars=options.are_cars)
    prior = fit_pca(samples, torch.tensor(grid.origin), grid.spacing_m, args.num_codes, provenance)
    prior.save(args.out)
    reasons = {name: _in_options(x).removeprefix(f"{args.meshes / name}: ") for name, x in skipped.items()}
    report = _report(prior, samples, tuple(grids), reasons)
    atomic_files.write_json(args.out.with_suffix(".json"), report)
    print(_report_text(args.out, report))
    if any(isinstance(problem, UnlikelyMeshError) and problem.cure for problem in skipped.values()):
        print("to use those too, bring all meshes to the same axes and unit first (docs/bring_your_own_shapes.md)")
    return 3 if skipped else 0


def _check_enough(num_usable: int, skipped: Mapping[str, Exception], num_codes: int) -> None:
    if num_usable > num_codes:
        return
    expected = f"more than --num-codes = {num_codes} usable meshes"
    cures = Counter(_options(x.cure) for x in skipped.values() if isinstance(x, UnlikelyMeshError) and x.cure)
    cure = "add meshes or lower --num-codes"
    if cures:
        cure = "; ".join(f"{count} of them look like cars with {options}" for options, count in cures.most_common(3))
    reasons = [_in_options(problem) for problem in skipped.values()]
    several = f"{len(skipped)} skipped: {'; '.join(reasons)}"
    first = f"{len(skipped)} skipped, the first: {reasons[0]}" if len(reasons) > 1 and cures else several
    raise InputError("--meshes", expected, f"{num_usable}{f' ({first})' if skipped else ''}", cure)


def _in_options(problem: Exception) -> str:
    """The problem of a mesh, with its cure as options of this command."""
    if not isinstance(problem, UnlikelyMeshError):
        return str(problem)
    needs = f"it needs {_options(problem.cure)}, or " if problem.cure else ""
    return f"{problem.found}; {needs}--not-cars if it is of another class"


def _options(fields: Mapping[str, str | float]) -> str:
    """Fields of `MeshOptions` as options of this command."""
    return " ".join(f"--{name.removesuffix('_m').replace('_', '-')}={value}" for name, value in fields.items())


def _grid_around(files: list[Path], spacing_m: float, options: MeshOptions) -> GridSpec:
    """A grid that contains all meshes; unreadable meshes and meshes larger than any vehicle are refused later."""
    corners = []
    for file in files:
        with suppress(DataFormatError, MeshError):
            corners.append(load_mesh_obj(file, options).bounds)
    fitting = [both for both in corners if np.ptp(both, axis=0).max() <= _LARGEST_M]
    if not fitting:
        raise InputError("--scale", f"meshes of at most {_LARGEST_M:g} m", f"none of {len(files)}", "give their unit")
    low_high = np.array(fitting)
    return GridSpec.around(low_high[:, 0].min(axis=0), low_high[:, 1].max(axis=0), spacing_m)


def _find_meshes(folder: Path, pattern: str) -> list[Path]:
    """Mesh files below a folder, sorted."""
    if not folder.is_dir():
        raise InputError("--meshes", "a folder", str(folder))
    every = (file for file in folder.glob(pattern) if file.suffix.lower() in MESH_SUFFIXES and file.is_file())
    # macOS writes a ._NAME beside each file that it copies.
    files = sorted(file for file in every if not file.name.startswith("."))
    if not files:
        raise InputError("--meshes", f"{', '.join(MESH_SUFFIXES)} files matching {pattern!r}", f"none in {folder}")
    return files


def _read_meshes(
    files: list[Path], folder: Path, grid: GridSpec, options: MeshOptions
) -> tuple[dict[str, Tensor], dict[str, Exception]]:
    """Signed distance grids by file name, and why the others were skipped."""
    grids: dict[str, Tensor] = {}
    skipped: dict[str, Exception] = {}
    for file in tqdm(files, desc="meshes", unit="mesh"):
        name = str(file.relative_to(folder))
        try:
            grids[name] = torch.from_numpy(mesh_to_sdf(load_mesh_obj(file, options), grid, options, name))
        except (DataFormatError, MeshError) as problem:
            skipped[name] = problem
    return grids, skipped


def _report(prior: PCAShapePrior, samples: Tensor, names: tuple[str, ...], skipped: dict[str, str]) -> dict[str, Any]:
    """The content of the JSON file beside the prior.

    The error is the mean |reconstructed - true| distance within 7 cm of the surface of cars left out, None for two
    cars.
    """
    errors = leave_one_out_errors_cm(samples, prior).tolist() if len(samples) >= 3 else []
    return {
        "schema": REPORT_SCHEMA,
        "num_meshes": len(samples),
        "num_codes": prior.num_codes,
        "spacing_m": prior.spacing_m,
        "explained_variance_ratio": [round(share, 5) for share in prior.explained_variance_ratio.tolist()],
        "leave_one_out_error_cm": round(fmean(errors), 3) if errors else None,
        "leave_one_out_num_cars": len(errors),
        "mean_height_width_length_m": [round(d, 3) for d in prior.dimensions_mean_hwl.tolist()],
        "std_height_width_length_m": [round(d, 3) for d in prior.dimensions_std_hwl.tolist()],
        "meshes": names,
        "skipped": skipped,
    }


def _report_text(out: Path, report: dict[str, Any]) -> str:
    shares = report["explained_variance_ratio"]
    sizes = zip(report["mean_height_width_length_m"], report["std_height_width_length_m"], strict=True)
    error, num_left_out = report["leave_one_out_error_cm"], report["leave_one_out_num_cars"]
    lines = [
        f"{out}: {report['num_codes']} components of {report['num_meshes']} meshes (report .json beside it)",
        f"explained variance, %: {' '.join(f'{100 * x:.1f}' for x in shares)} (sum {100 * sum(shares):.1f})",
        "leave-one-out error within 7 cm of the surface: "
        + (f"{error:.2f} cm (mean over {num_left_out} cars)" if num_left_out else "not known, of two cars"),
        "height, width, length, m: " + ", ".join(f"{mean:.2f} +- {std:.2f}" for mean, std in sizes),
    ]
    return "\n".join(
        lines + [f"skipped {name}: {reason.removeprefix(f'{name}: ')}" for name, reason in report["skipped"].items()]
    )
