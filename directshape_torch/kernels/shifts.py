"""This module evaluates `refinement.disparity_profile.shifted_costs`, one block after the other."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Comparison, Doubles, Flags, Pixels, Reals
from directshape_torch.kernels.grid import ONE, ZERO
from directshape_torch.kernels.jit import SOURCES, loop
from directshape_torch.kernels.photometric import add_neighbours, compare, compared_for
from directshape_torch.kernels.right_view import drop_hidden, patches_for


@loop
def shifted(
    pixels: Pixels,
    comparison: Comparison,
    parts: Reals,
    depth: Reals,
    on_surface: Flags,
    per_px: Reals,
    offsets_px: Reals,
    costs: Doubles,
    _sources: int = SOURCES,
) -> None:
    """Write the costs (Q, S, n, B) of parts (Q, B, R) of the pixels, with surfaces (S, B, R) moved by n disparities."""
    num_rows = depth.shape[2]
    moved, usable = np.empty(num_rows, np.float32), np.empty(num_rows, np.bool_)
    patches, compared = patches_for(num_rows), compared_for(len(pixels.intensity_left), num_rows)
    for surface in range(np.uint64(len(depth))):
        for n in range(np.uint64(len(offsets_px))):
            for car in range(np.uint64(len(per_px))):
                for row in range(np.uint64(num_rows)):
                    inverse = ONE / depth[surface, car, row] + offsets_px[n] * per_px[car]
                    moved[row], usable[row] = ONE / inverse, on_surface[surface, car, row] and inverse > ZERO
                compare(pixels, comparison, car, moved, patches, compared, usable)
                drop_hidden(pixels, car, np.uint64(comparison.centre), moved, patches, usable)
                add_neighbours(pixels, comparison, car, usable, compared)
                for part in range(np.uint64(len(parts))):
                    total = 0.0
                    for row in range(np.uint64(num_rows)):
                        total += parts[part, car, row] * compared.cost[row]
                    costs[part, surface, n, car] = total
