"""Numbers as JSON can hold them: rounded, and null for what is not finite."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


def known(value: float | np.floating[Any] | None, decimals: int = 4) -> float | None:
    """A number as JSON can hold it: rounded, and None where it is not finite.

    Examples:
        >>> known(0.123456), known(float("nan"))
        (0.1235, None)
    """
    return None if value is None or not math.isfinite(value) else round(float(value), decimals)


def numbers(values: Sequence[float] | npt.NDArray[np.floating[Any]], decimals: int = 5) -> list[float | None]:
    """Several of them.

    Examples:
        >>> numbers(np.array([0.123456, np.inf]), 2)
        [0.12, None]
    """
    return [known(value, decimals) for value in values]
