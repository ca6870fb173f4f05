"""Doubts about intrinsics stay until matches of the two images settle them."""

from __future__ import annotations

from pathlib import Path

import directshape_torch
from directshape_torch.check.check_images import with_images
from directshape_torch.check.finding import found
from directshape_torch.io.image_files import read_pair

TRAINING = Path(directshape_torch.__file__).parent / "assets" / "demo" / "training"


def test_matches_alone_settle_a_doubt_about_intrinsics() -> None:
    left, right = (next((TRAINING / folder).glob("000000.*")) for folder in ("image_2", "image_3"))
    pair = read_pair(left, right)
    doubt = found("raw_intrinsics", "frame a", "left and right differ", severity="warning")
    assert with_images([doubt], pair, None, "frame a", match_images=False) == [doubt]
    assert with_images([doubt], pair, None, "frame a", match_images=True) == []
