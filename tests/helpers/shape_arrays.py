"""This module makes the refined cars of a frame in their file format, with arbitrary numbers."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from directshape_torch.io.result_files import ShapeArrays


def shape_arrays(num_cars: int, **changes: Any) -> ShapeArrays:
    """Up to three cars with five codes and two terms; `changes` replace single fields."""
    random = np.random.default_rng(num_cars)
    B, K, T = num_cars, 5, 2
    arrays = ShapeArrays(
        frame_id="000107",
        prior_sha256="ab" * 32,
        ground_source="file",
        input_lines=np.arange(B, dtype=np.int64) + 1,
        tracks=("000031", "", "000007")[:B],
        track_parts=np.full(B, -1, dtype=np.int64),
        T_cam_obj=random.random((B, 4, 4)),
        T_ref_obj=random.random((B, 4, 4)),
        boxes_hwl=random.random((B, 3)),
        boxes_location_ref=random.random((B, 3)),
        boxes_rotation_y=random.random(B),
        codes=random.random((B, K)).astype(np.float32),
        covariances=np.full((B, 6 + K, 6 + K), np.nan),
        covariances_ref=random.random((B, 4, 4)),
        statuses=("converged", "no_mask", "max_iterations")[:B],
        messages=("", "no mask in either image", "")[:B],
        term_names=("silhouette", "shape prior"),
        costs_before=random.random((B, T)),
        costs_after=random.random((B, T)),
        iterations=np.full(B, 7, dtype=np.int64),
        has_mask_left=np.ones(B, dtype=bool),
        mask_iou_left=np.full(B, 0.9),
        mask_iou_right=np.full(B, 0.9),
        photometric_errors_grey=np.full(B, 4.0),
        matched_shares=np.ones(B),
        probabilities_better=np.full(B, 0.9),
        probabilities_not_worse=np.full(B, 0.97),
        probabilities_heading=np.full(B, np.nan),
        distances_in_sigmas=np.full(B, 2.6),
        sigmas_ref=random.random((B, 4)),
        unseen=("rear view: length alone (sigma 0.20 m)", "", "")[:B],
        unseen_sigmas_m=random.random((B, 7)),
        unseen_directions=random.random((B, 7, 7)),
        profile_offsets_px=np.linspace(-3, 3, 25),
        profile_costs_before=random.random((B, 25)),
        profile_costs_after=random.random((B, 25)),
    )
    return dataclasses.replace(arrays, **changes)
