"""This script counts how often wrong axes and units of real meshes are found, for 24 rotations and seven units.

    python scripts/mesh_turns.py --meshes DIR

For each unit it prints how many cases were refused, with which named axes and unit, and which wrong ones passed. Meshes
are in metres with x forward and z up; glb files have z forward and y up.
"""

from __future__ import annotations

import argparse
from collections import Counter
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import UnlikelyMeshError
from directshape_torch.files.mesh_files import MESH_SUFFIXES, read_mesh
from directshape_torch.shape.car_looks import check_looks
from directshape_torch.shape.outlines import AXES, Outlines

TURNS = [(forward, up) for forward, up in permutations(AXES, 2) if AXES[forward] != AXES[up]]
# These are units per metre, and the option that names them; a mesh of unit size has no unit.
UNITS: dict[str, tuple[float | None, tuple[str, float] | None]] = {
    "metres": (1.0, None),
    "millimetres": (1e3, ("scale", 0.001)),
    "centimetres": (1e2, ("scale", 0.01)),
    "inches": (1 / 0.0254, ("scale", 0.0254)),
    "feet": (1 / 0.3048, ("scale", 0.3048)),
    "kilometres": (1e-3, ("scale", 1e3)),
    "unit size": (None, ("length_m", 4.2)),
}


def vector(axis: str) -> NDArray[np.float64]:
    return np.eye(3)[AXES[axis]] * (1.0 if axis[0] == "+" else -1.0)


def triangles_of(path: Path) -> NDArray[np.float64]:
    """Triangles (F, 3, 3) of a mesh file, x forward, y to the left, z up."""
    vertices, faces = read_mesh(path)
    upright: NDArray[np.float64] = vertices[:, [2, 0, 1]] if path.suffix == ".glb" else vertices
    return upright[faces]


def needed(triangles: NDArray[np.float64], forward: str, up: str, factor: float) -> dict[str, str | float] | None:
    """The options that a mesh with front and roof along these axes needs, or None if it passes unchanged."""
    left = np.cross(vector(up), vector(forward))
    turned = factor * triangles @ np.stack([vector(forward), left, vector(up)])
    try:
        check_looks(Outlines.of_triangles(turned), "+x", "+z", name="mesh")
    except UnlikelyMeshError as problem:
        return problem.cure
    return None


def outcome(triangles: NDArray[np.float64], forward: str, up: str, unit: str) -> str:
    """The result for a mesh in a rotation and a unit, in a few words."""
    factor, size_option = UNITS[unit]
    cure = needed(triangles, forward, up, 1 / float(np.ptp(triangles[..., 0])) if factor is None else factor)
    if cure is None:
        return "passed, right" if (forward, up) == ("+x", "+z") else "passed, wrong"
    front, roof = str(cure.pop("forward_axis", "+x")), cure.pop("up_axis", "+z")
    if cure != dict([size_option] if size_option else []) or roof != up or front[1] != forward[1]:
        return "refused, named wrong"
    return "refused, named right" if front == forward else "refused, front and rear exchanged"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, required=True)
    files = sorted(file for file in parser.parse_args().meshes.rglob("*") if file.suffix in MESH_SUFFIXES)
    meshes = {f"{file.parent.name}/{file.stem}": triangles_of(file) for file in files}
    for unit in UNITS:
        cases = {(name, *turn): outcome(meshes[name], *turn, unit) for name in meshes for turn in TURNS}
        counts = Counter(cases.values()).most_common()
        print(f"{unit}: {', '.join(f'{count} {words}' for words, count in counts)}")
        for case, words in cases.items():
            if words == "passed, wrong":
                print(f"  passed, wrong: {' '.join(case)}")


if __name__ == "__main__":
    main()
