"""This module keeps what matching two images gives: matching is slow, and most tests do not change the images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from directshape_torch.check import check_images, check_lidar


def _remembered(match: Callable[..., Any]) -> Callable[..., Any]:
    answers: dict[bytes, Any] = {}

    def answered(left: Any, right: Any) -> Any:
        key = b"".join(np.ascontiguousarray(image).tobytes() for image in (left, right))
        if key not in answers:
            answers[key] = match(left, right)
        return answers[key]

    return answered


_match_pair, _match_disparity = _remembered(check_images.match_pair), _remembered(check_lidar.match_disparity)


@contextmanager
def matched_once() -> Iterator[None]:
    """The checks of scenes match equal images once while the body runs, and not again in a later body."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_images, "match_pair", _match_pair)
        patch.setattr(check_lidar, "match_disparity", _match_disparity)
        yield
