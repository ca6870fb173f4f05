"""Probabilities agree with sampled IoUs of boxes, with numbers by hand and with a file, also at the borders."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from directshape_torch.evaluation.pose_error import pose_errors
from directshape_torch.refinement.observability import HEADING_LEVER_M
from directshape_torch.refinement.trust import (
    ImageNoise,
    LogisticHead,
    TrustModel,
    bundled_trust_model,
    probabilities,
    trust_model_of,
)

HEAD = LogisticHead((0.5, 0.1, 0.0), (2.0, 0.05, 1.0), (1.0, -2.0, 0.5), 0.25)
MODEL = TrustModel(HEAD, ImageNoise((1.0,) * 7, (0.1,) * 7), {"made_by": "a test"})
HWL = torch.tensor([[1.5, 1.6, 4.0]]).double()
SIGMAS = torch.tensor([0.3, 0.1, 0.05, 0.1, 0.2, 0.05, 0.05]).double()


def evidence(*columns: float) -> Tensor:
    return torch.tensor([columns]).double()


def test_a_head_is_the_logistic_function_of_standardised_columns() -> None:
    # (1.5 - 0.5) / 2 = 0.5 and (0.15 - 0.1) / 0.05 = 1: 0.25 + 0.5 - 2 = -1.25.
    expected = 1 / (1 + math.exp(1.25))
    torch.testing.assert_close(HEAD(evidence(1.5, 0.15, 0.0)), torch.tensor([expected]).double())


def test_beyond_three_deviations_nothing_changes_and_unknown_counts_as_the_mean() -> None:
    torch.testing.assert_close(HEAD(evidence(100.0, 0.1, 0.0)), torch.tensor([1 / (1 + math.exp(-3.25))]).double())
    torch.testing.assert_close(HEAD(evidence(torch.nan, 0.1, 0.0)), torch.tensor([1 / (1 + math.exp(-0.25))]).double())


def student(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(count, 7, generator=generator, dtype=torch.float64)
    return (
        normal / torch.randn(count, 4, generator=generator, dtype=torch.float64).square().mean(1, keepdim=True).sqrt()
    )


@pytest.mark.parametrize("turned", [0.0, 0.7, math.pi / 2])
def test_probabilities_are_those_of_sampled_overlaps(turned: float) -> None:
    """True boxes are drawn about the most probable one, and overlaps of rotated boxes are counted."""
    moved = torch.tensor([[0.4, -0.1, 0.0, 0.2, 0.3, 0.0, 0.0]]).double()
    better, not_worse = probabilities(
        torch.zeros(1, 7).double(), moved, torch.diag(SIGMAS**2)[None], HWL, torch.tensor([turned]).double()
    )

    def boxes(of: Tensor) -> Tensor:
        """KITTI boxes straight ahead; depth is z, sideways x, and a heading of 0 is across the ray."""
        depth, side, _, heading, length, width, height = of.unbind(dim=1)
        heading = heading / HEADING_LEVER_M + turned + math.pi / 2
        # A turn to the right lowers the angle that `turned` is counted in.
        place = torch.stack([side, 0 * side, 30 + depth], dim=1)
        sizes = HWL[0] + torch.stack([height, width, length], dim=1)
        return torch.cat([place, sizes, heading[:, None]], dim=1)

    truth = student(4000) * SIGMAS
    of_truth, many = boxes(truth), torch.ones(len(truth), 1).double()
    returned, detector = (
        pose_errors(boxes(many * box), of_truth).bev_iou for box in (torch.zeros(1, 7).double(), moved)
    )
    assert float(better) == pytest.approx(float((returned > detector).double().mean()), abs=0.06)
    assert float(not_worse) == pytest.approx(float((returned > detector - 0.05).double().mean()), abs=0.06)


def test_who_does_not_move_is_not_worse_and_who_moves_far_is_better_if_that_is_known() -> None:
    nothing, far = torch.zeros(2, 7).double(), torch.zeros(2, 7).double()
    far[:, 0] = 3.0
    covariance = torch.diag(SIGMAS**2).repeat(2, 1, 1)
    covariance[1, 0, 0] = 100.0
    at_once = (HWL.repeat(2, 1), torch.zeros(2).double())
    assert probabilities(nothing, nothing, covariance, *at_once)[1].tolist() == [1.0, 1.0]
    sure, unsure = probabilities(nothing, far, covariance, *at_once)[0].tolist()
    assert sure > 0.95
    assert unsure < 0.75
    # With the boxes exchanged the detector's is the better one.
    assert probabilities(far, nothing, covariance, *at_once)[0][0] < 0.05


def test_what_is_not_known_has_no_probability_and_touches_no_other_car() -> None:
    boxes, covariance = torch.zeros(3, 7).double(), torch.diag(SIGMAS**2).repeat(3, 1, 1)
    boxes[:, 0] = 0.2
    covariance[0] = torch.nan
    boxes[2, 3] = torch.nan
    better, not_worse = probabilities(0 * boxes[:1].expand(3, 7), boxes, covariance, HWL.repeat(3, 1), torch.zeros(3))
    assert better.isnan().tolist() == not_worse.isnan().tolist() == [True, False, True]


def test_a_model_is_read_as_it_was_written_and_one_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    MODEL.save(path)
    content = json.loads(path.read_text())
    assert trust_model_of(content) == MODEL
    with pytest.raises(ValueError, match="schema 'other/1', this version reads"):
        trust_model_of(content | {"schema": "other/1"})


def test_the_bundled_model_is_physically_sensible() -> None:
    """Halves that lie apart, an error beside the contrast, and a box far from the detector's lower the trust."""
    model = bundled_trust_model()
    assert max(model.car_is_there.weights) < 0
    assert min(*model.image_noise.floors_m) > 0
    assert model.provenance["made_by"] == "scripts/calibrate_trust.py"
