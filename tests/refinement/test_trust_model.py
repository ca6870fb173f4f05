"""Probabilities and calibrated sigmas: against the formulas by hand, from file, and at the borders."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.refinement.quality import (
    EVIDENCE_NAMES,
    LogisticHead,
    TrustModel,
    bundled_trust_model,
    trust_model_of,
)

HEAD = LogisticHead(("log_sigma_yaw", "turned"), (0.5, 0.1), (2.0, 0.05), (1.0, -2.0), 0.25)
MODEL = TrustModel(HEAD, HEAD, (2.0, 3.0, 1.0, 0.5), (0.1, 0.2, 0.0, 0.01), {"made_by": "a test"})


def evidence(log_sigma_yaw: float, turned: float) -> torch.Tensor:
    row = torch.full((1, len(EVIDENCE_NAMES)), torch.nan, dtype=torch.float64)
    row[0, EVIDENCE_NAMES.index("log_sigma_yaw")] = log_sigma_yaw
    row[0, EVIDENCE_NAMES.index("turned")] = turned
    return row


def test_a_head_is_the_logistic_function_of_standardised_columns() -> None:
    # (1.5 - 0.5) / 2 = 0.5 and (0.15 - 0.1) / 0.05 = 1: 0.25 + 0.5 - 2 = -1.25.
    expected = 1 / (1 + math.exp(1.25))
    torch.testing.assert_close(HEAD(evidence(1.5, 0.15)), torch.tensor([expected]).double())


def test_beyond_three_deviations_nothing_changes_and_unknown_counts_as_the_mean() -> None:
    torch.testing.assert_close(HEAD(evidence(100.0, 0.1)), torch.tensor([1 / (1 + math.exp(-3.25))]).double())
    torch.testing.assert_close(HEAD(evidence(torch.nan, 0.1)), torch.tensor([1 / (1 + math.exp(-0.25))]).double())


def test_sigmas_are_scaled_along_and_across_the_viewing_ray() -> None:
    """Straight ahead the ray is z and x lies across it."""
    covariance = torch.diag(torch.tensor([0.01, 0.04, 0.09, 0.0004])).double()[None]
    calibrated = MODEL.calibrated_covariance(covariance, torch.tensor([[0.0, 1.6, 20.0]]))
    expected = [(3 * 0.1) ** 2 + 0.2**2, 0.2**2, (2 * 0.3) ** 2 + 0.1**2, (0.5 * 0.02) ** 2 + 0.01**2]
    torch.testing.assert_close(calibrated[0], torch.diag(torch.tensor(expected).double()))


@settings(max_examples=25, deadline=None)
@given(st.floats(-math.pi, math.pi))
def test_sigmas_turn_with_the_scene(angle: float) -> None:
    """A scene turned about the vertical axis gives the same covariance, turned."""
    c, s = math.cos(angle), math.sin(angle)
    R = torch.eye(4, dtype=torch.float64)
    R[0, 0], R[0, 2], R[2, 0], R[2, 2] = c, s, -s, c
    A = torch.randn(4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    covariance, location = (A @ A.T)[None], torch.tensor([[3.0, 1.5, 14.0]]).double()
    turned = MODEL.calibrated_covariance(R @ covariance @ R.T, location @ R[:3, :3].T)
    torch.testing.assert_close(turned, R @ MODEL.calibrated_covariance(covariance, location) @ R.T)


def test_a_model_is_read_as_it_was_written_and_one_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    MODEL.save(path)
    content = json.loads(path.read_text())
    assert trust_model_of(content) == MODEL
    with pytest.raises(ValueError, match="schema 'other/1', this version reads"):
        trust_model_of(content | {"schema": "other/1"})


def test_a_write_that_fails_leaves_the_old_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model.json"
    MODEL.save(path)
    whole = path.read_bytes()

    def full_disk(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match="disk full"):
        replace(MODEL, provenance={}).save(path)
    assert path.read_bytes() == whole


def test_the_bundled_model_is_physically_sensible() -> None:
    """More uncertainty, a larger turn, a mask missed lower the trust; a larger fall of the costs raises it."""
    model = bundled_trust_model()
    for head in (model.better, model.not_worse):
        weight = dict(zip(head.columns, head.weights, strict=True))
        assert max(weight[name] for name in ("turned", "log_sigma_yaw", "mask_misfit_left")) < 0
        assert weight["relative_decrease"] > 0
    # Less is expected of a detector that is good already.
    assert dict(zip(model.better.columns, model.better.weights, strict=True))["log_detector_sigma"] > 0
    assert model.provenance["made_by"] == "scripts/calibrate_quality.py"
