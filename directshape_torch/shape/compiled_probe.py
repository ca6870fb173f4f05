"""Entries of rays into grids, narrowed down coordinate first: the form that is compiled.

One probe and not all of them: called again and again it takes a fraction of the time to compile, and as little to run.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.shape.bracket import Bracket
from directshape_torch.shape.compiled_march import RayRows
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.grid_lookup import derivatives_at


def compiled_entry(field: GridField, rows: RayRows, bracket: Bracket, num_probes: int) -> tuple[Tensor, Tensor]:
    """Where P rays enter grids: best depth (P,) of their bracket after so many probes; the gradient (P, 3) there."""
    parts = rows.in_rows(torch.stack([part for part in bracket if part.is_floating_point()]))
    for _ in range(num_probes):
        parts = probe_grids(*field, rows.rays_obj, rows.object_index, parts).bracket
    best = _bracket(parts).best
    # What would be probed next is the best itself, for its gradient.
    at_best = probe_grids(*field, rows.rays_obj, rows.object_index, torch.cat([best[None], parts[1:]]))
    return rows.packed(best), rows.packed(at_best.gradient).mT


class Probed(NamedTuple):
    """Brackets of rays in rows after a probe, and what was found there."""

    bracket: Tensor  # (7, M, ROW) floating-point parts of a `Bracket`, in order
    gradient: Tensor  # (3, M, ROW) of the signed distance


@compilable(sizes={"values": 0, "rays_obj": 1, "object_index": 0, "bracket": 1})
def probe_grids(
    values: Tensor,
    basis: Tensor,
    origin: Tensor,
    last_node: Tensor,
    spacing_m: float,
    rays_obj: Tensor,  # (6, M, ROW) origin, direction
    object_index: Tensor,  # (M, ROW)
    bracket: Tensor,  # (7, M, ROW) floating-point parts of a `Bracket`, in order
) -> Probed:
    """One probe of every ray (`Bracket.probed`)."""
    before = _bracket(bracket)
    point = torch.addcmul(rays_obj[:3], before.depth, rays_obj[3:])
    at = derivatives_at(GridField(values, basis, origin, last_node, spacing_m), point, object_index, constant=True)
    after = before.probed(at.value)
    return Probed(torch.stack([part for part in after if part.is_floating_point()]), at.gradient)


def _bracket(parts: Tensor) -> Bracket:
    # The one part that is no number follows from another.
    depth, latest, latest_sdf, *others = parts
    return Bracket(depth, latest, latest_sdf, latest_sdf < 0, *others)
