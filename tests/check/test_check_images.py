"""Doubts about intrinsics stay until matches of the two images settle them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.bundled_frame import DEMO

from directshape_torch.check.check_images import check_frame
from directshape_torch.check.mistakes import words_of_files
from directshape_torch.io.image_files import read_pair


def test_matches_alone_settle_a_doubt_about_intrinsics() -> None:
    left, right = (next((DEMO / "training" / folder).glob("000000.*")) for folder in ("image_2", "image_3"))
    pair = read_pair(left, right)
    height, width = pair[0].shape[:2]
    K = np.array([[0.6 * width, 0.0, 0.5 * width], [0.0, 0.6 * width, 0.5 * height], [0.0, 0.0, 1.0]])
    numbers = ({"left": K, "right": K + np.array([[0, 0, 0], [0, 0, 1], [0, 0, 0]])}, 0.5)
    for match_images, said in ((False, [("raw_intrinsics", "warning")]), (True, [])):
        of_frame, _, usable = check_frame(
            numbers, None, pair, (height, width), "frame a", words_of_files(Path("calib.txt")), match_images
        )
        assert [(one.check, one.severity) for one in of_frame] == said
        assert usable is pair
