"""Whether what is computed now can be differentiated."""

from __future__ import annotations

import torch


def nothing_is_differentiated() -> bool:
    """Whether neither gradients nor a forward mode are on; `torch.func` enables gradients or opens a level of its own.

    Example:
        >>> with torch.no_grad():
        ...     nothing_is_differentiated()
        True
        >>> with torch.no_grad():
        ...     torch.func.jvp(lambda x: x * nothing_is_differentiated(), (torch.ones(1),), (torch.ones(1),))
        (tensor([0.]), tensor([0.]))
    """
    return not (torch.is_grad_enabled() or is_forward_mode())


def is_forward_mode() -> bool:
    """Whether this is inside a region of forward-mode differentiation.

    Example:
        >>> with torch.autograd.forward_ad.dual_level():
        ...     is_forward_mode()
        True
    """
    return torch.autograd.forward_ad._current_level >= 0
