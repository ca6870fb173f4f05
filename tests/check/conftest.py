"""Tests of checks match equal images once: matching is slow, and most of these tests do not change the images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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


_PAIR, _DISPARITY = _remembered(check_images.match_pair), _remembered(check_lidar.match_disparity)


@pytest.fixture(scope="module", autouse=True)
def _match_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_images, "match_pair", _PAIR)
        patch.setattr(check_lidar, "match_disparity", _DISPARITY)
        yield
