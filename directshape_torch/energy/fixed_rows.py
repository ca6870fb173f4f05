"""Rows of a followed term with everything fixed that a linearisation holds constant."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from directshape_torch.tracking.blocks import BlockParts
from directshape_torch.tracking.field import BlockField


class FixedRows(NamedTuple):
    """Depths, hits and which rows count are those of one state."""

    residuals: Callable[[BlockField, Tensor], Tensor]
    """Residuals (M, 64, ...) of a field at poses (B, 4, 4), differentiable."""
    accumulate: Callable[[Tensor, Tensor], BlockParts]
    """What blocks add to the linearisation, from residuals and any Jacobian (M, 64, ..., D) of them."""
