"""Whether what something was computed from is still the same: how a problem knows what it may use again."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from directshape_torch.gradient_mode import is_plain, nothing_is_differentiated


@dataclass(frozen=True, eq=False)
class Origin:
    """Objects that something was computed from.

    They are held, so that no later object is taken for one of them by its address.

    Attributes:
        objects: tensors and others.
        versions: how often each of the tensors had been written to.
        numbers: values beside them.
    """

    objects: tuple[object, ...]
    versions: tuple[int, ...]
    numbers: tuple[float, ...]

    @classmethod
    def of(
        cls, tensors: Sequence[Tensor], others: Sequence[object] = (), numbers: Sequence[float] = ()
    ) -> Origin | None:
        """Of tensors, objects that never change, and numbers.

        None where writes are not counted (inference mode), and where what comes of them must be made anew each time: to
        be differentiated, or inside a transform of `torch.func`, which it would outlive.

        Example:
            >>> import torch
            >>> x = torch.zeros(2)
            >>> with torch.no_grad():
            ...     before = Origin.of([x])
            ...     unchanged = Origin.of([x]).is_same(before)
            ...     _ = x.add_(1)
            ...     unchanged, Origin.of([x]).is_same(before)
            (True, False)
        """
        if not nothing_is_differentiated() or any(x.is_inference() or not is_plain(x) for x in tensors):
            return None
        return cls((*tensors, *others), tuple(x._version for x in tensors), tuple(numbers))

    def is_same(self, other: Origin) -> bool:
        """The very same objects, none of them changed."""
        if self.versions != other.versions or self.numbers != other.numbers:
            return False
        return len(self.objects) == len(other.objects) and all(map(operator.is_, self.objects, other.objects))
