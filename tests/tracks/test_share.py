"""Views of a tracked car get one shape, views that are not trusted get none, and other cars stay unchanged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.street_inputs import SETTLED, summary, with_mode
from helpers.synthetic_scene import (
    CAMERA_HEIGHT_M,
    cached_street,
    disturbed,
    joined_detections,
    joined_frames,
    masked,
    select,
    street,
)
from helpers.track_drive import QUICK, assert_same, by_themselves, doubt, drive, of_tracks, refined
from kornia.filters import gaussian_blur2d
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.errors import InputError
from directshape_torch.refinement import refined as refinements
from directshape_torch.refinement.problem import CarMinimum, CarProblem
from directshape_torch.refinement.trust import EVIDENCE_NAMES
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.unknowns import POSE, AnyState
from directshape_torch.status import Status
from directshape_torch.terms.priors import PriorTerm, height_prior
from directshape_torch.tracks import same_car, share


def test_cars_beside_a_track_and_tracks_of_one_view_are_refined_as_by_themselves_to_the_bit() -> None:
    assert_same(of_tracks(4, -1, 9, -1, 2, -7), by_themselves())
    alone, mixed = by_themselves(), of_tracks(7, 1, 7, 1, 7, -1)
    assert torch.equal(mixed.T_cam_obj[5], alone.T_cam_obj[5])
    assert torch.equal(mixed.code[5], alone.code[5])


def test_views_of_a_track_get_one_shape_that_is_nearer_to_the_truth() -> None:
    _, detections, code = drive()
    alone, together = (refined(detections, ids, config=DEFAULT) for ids in (None, [0, 1] * 3))
    assert together.status == [Status.converged] * 6
    for track in (0, 1):
        views = together.code[track::2]
        assert (views == views[0]).all()
    errors = [(result.code - code)[0::2].square().mean().sqrt() for result in (alone, together)]
    assert errors[1] < 0.85 * errors[0]
    # What is known of shapes holds back each view, as often as the images push it.
    priors, costs = DEFAULT.priors, dict(zip(together.term_names, together.cost_after.unbind(dim=1), strict=True))
    torch.testing.assert_close(costs["shape"], priors.shape_weight * together.code.square().sum(dim=1) / 2)
    off = ellipsoid_prior().dimensions_and_derivative(together.code).hwl - detections.dimensions_hwl
    off = off / torch.tensor(priors.dimensions_sigma_m)
    torch.testing.assert_close(costs["dimensions"], priors.dimensions_weight * off.square().sum(dim=1) / 2)
    # What the other views say counts: no direction is known less, and none better than what views have in common.
    variances = [result.covariance.diagonal(dim1=1, dim2=2)[:, 6:] for result in (alone, together)]
    assert (variances[1] < variances[0]).all()
    assert (variances[1] > variances[0] / 2).all()
    assert (together.observability.sigmas_m.amax(dim=1) < alone.observability.sigmas_m.amax(dim=1)).all()


def test_the_evidence_of_a_view_is_that_of_its_own_unknowns() -> None:
    frames, detections, _ = drive()
    timed = replace(frames, time_s=torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64))
    track = replace(detections, track_id=torch.tensor([0, 1] * 3))
    for result in (of_tracks(*[0, 1] * 3), DirectShapeRefiner(ellipsoid_prior(), QUICK)(timed, track)):
        assert result.track_part.tolist() == [0] * 6
        # Nobody said how good the detector is.
        unknown = [name for name, x in zip(EVIDENCE_NAMES, result.quality.evidence.mT, strict=True) if x.isnan().any()]
        assert unknown == ["log_detector_distance"]


def test_a_batch_of_tracks_equals_a_loop_in_any_order() -> None:
    together = of_tracks(7, 1, 7, 1, 7, -1)
    for track_id, rows in (([3, -1, 3, -1, 3, -1], [0, 2, 4]), ([-1, 3, -1, 3, -1, -1], [1, 3])):
        one = of_tracks(*track_id)
        torch.testing.assert_close(together.T_cam_obj[rows], one.T_cam_obj[rows], rtol=0, atol=1e-9)
        torch.testing.assert_close(together.code[rows], one.code[rows], rtol=0, atol=1e-9)
    # The order of the detections does not matter either.
    _, detections, _ = drive()
    order, track_id = torch.tensor([4, 1, 0, 5, 3, 2]), [7, 1, 7, 1, 7, -1]
    shuffled = select(replace(detections, track_id=torch.tensor(track_id)), order)
    assert shuffled.track_id is not None
    moved = refined(shuffled, shuffled.track_id.tolist())
    torch.testing.assert_close(moved.T_cam_obj, together.T_cam_obj[order], rtol=0, atol=1e-9)
    torch.testing.assert_close(moved.code, together.code[order], rtol=0, atol=1e-9)


def test_a_track_of_two_cars_is_split_where_they_were_swapped(monkeypatch: pytest.MonkeyPatch) -> None:
    # The few pixels of a toy know its shape less well than those of a street.
    monkeypatch.setattr(same_car, "_MOST_EVIDENCE", 3.0)
    _, detections, _ = drive(contrast=2.5)
    right, swapped = (refined(detections, ids, contrast=2.5) for ids in ([0, 1] * 3, [0, 1, 0, 1, 1, 0]))
    assert right.track_part.tolist() == [0] * 6
    assert swapped.track_part.tolist() == [0] * 4 + [-1] * 2
    alone = refined(detections, [-1] * 6, contrast=2.5)
    assert torch.equal(swapped.code[4:], alone.code[4:])


@cache
def calm_drive() -> tuple[FrameBatch, Detections]:
    """Four frames of two cars of one shape and different paint."""
    code = torch.tensor([[0.9, -0.4, 0.5]] * 2, dtype=torch.float64)
    height = CAMERA_HEIGHT_M
    seen = [
        street(ellipsoid_prior(), [(-1.6, height, 8.0 + 0.3 * n), (1.8, height, 8.5)], [-1.2 + 0.1 * n, -1.0], code)
        for n in range(4)
    ]
    detections = joined_detections([view.detections for view in seen], (120, 160))
    return joined_frames([view.frames for view in seen]), disturbed(detections, metres=0.05, radians=0.02)


@pytest.mark.parametrize("next_view_weight", [0.15, pytest.param(0.0, marks=pytest.mark.long)])
def test_two_cars_of_one_shape_are_told_apart_by_their_looks(next_view_weight: float) -> None:
    frames, detections = calm_drive()
    config = replace(DEFAULT, tracks=replace(DEFAULT.tracks, next_view_weight=next_view_weight))
    refiner = DirectShapeRefiner(ellipsoid_prior(), config)
    parts = [
        refiner(frames, replace(detections, track_id=torch.tensor(ids))).track_part.tolist()
        for ids in ([0, 1] * 4, [0, 1, 0, 1, 1, 0, 1, 0])
    ]
    assert parts[0] == [0] * 8
    # Without a look at the next view the shapes alone do not tell.
    assert parts[1] == ([0] * 4 + [1] * 4 if next_view_weight else [0] * 8)


def test_a_view_without_a_mask_touches_nothing_else() -> None:
    _, detections, _ = drive()
    present = torch.arange(len(detections)) != 2
    unmasked = masked(detections, present, present)
    broken = refined(unmasked, [0, 1] * 3)
    assert broken.status[2] == Status.no_mask
    assert torch.equal(broken.T_cam_obj[2], detections.T_cam_obj[2])
    whole = refined(select(detections, torch.tensor([0, 1, 3, 4, 5])), [0, 1, 1, 0, 1])
    rows = [0, 1, 3, 4, 5]
    torch.testing.assert_close(broken.T_cam_obj[rows], whole.T_cam_obj, rtol=0, atol=1e-9)


def test_a_view_that_the_images_do_not_confirm_does_not_join() -> None:
    _, detections, _ = drive()
    far = detections.T_cam_obj.clone()
    far[2, :3, 3] *= 4.0
    wrong = replace(detections, T_cam_obj=far)
    result = refined(wrong, [0, 1] * 3)
    assert result.status[2] in {Status.mask_missed, Status.no_match}
    assert torch.equal(result.T_cam_obj[2], far[2])
    without = refined(wrong, [0, 1, -1, 1, 0, 1])
    rows = [0, 1, 3, 4, 5]
    assert torch.equal(result.T_cam_obj[rows], without.T_cam_obj[rows])
    assert (result.code[4] == result.code[0]).all()


@pytest.mark.parametrize(
    ("mode", "time_s", "doubted"),
    [
        ("unroll", None, ""),
        pytest.param("unroll", None, "alone", marks=pytest.mark.long),
        pytest.param("unroll", (0, 0.1), "in_track", marks=pytest.mark.long),
        pytest.param("implicit", None, "in_track", marks=pytest.mark.long),
        ("implicit", (0, 0.1), "alone"),
        pytest.param("implicit_gauss_newton", None, "", marks=pytest.mark.long),
    ],
)
def test_gradients_of_a_track_are_those_of_differences(
    mode: str, time_s: tuple[float, float] | None, doubted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if doubted == "in_track":
        doubt(monkeypatch, 1, num_rows=2)
    elif doubted:
        doubt(monkeypatch, alone=1, num_rows=2)
    prior, scene = cached_street()
    frames = joined_frames([scene.frames] * 2)
    if time_s is not None:
        frames = replace(frames, time_s=torch.tensor(time_s, dtype=torch.float64))
    # The same picture twice: a minimum without a kink.
    first = replace(disturbed(scene.detections), mask_left=scene.detections.mask_left.dense().clamp(0.2, 0.8))
    first = select(first, torch.tensor([0]))
    track = replace(joined_detections([first, first], (120, 160)), track_id=torch.tensor([5, 5]))
    direction = 0.02 * torch.randn(frames.images_right.shape, generator=torch.Generator().manual_seed(5)).double()
    # One view holds back the other, whose pictures change.
    direction[1] = 0

    def summary_at(config: RefinerConfig, by: Tensor | float) -> Tensor:
        if (mode, doubted) == ("unroll", "alone"):
            # So few that it matters where the track begins.
            config = replace(config, stages=tuple(replace(stage, max_iterations=2) for stage in config.stages))
        moved = replace(frames, images_right=frames.images_right + by * direction)
        result = DirectShapeRefiner(prior, config)(moved, track)
        assert (doubted != "in_track") == bool((result.code[0] == result.code[1]).all())
        return summary(result)

    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(summary_at(with_mode(mode), by), by)
    step = 1e-5
    numeric = float(summary_at(SETTLED, step) - summary_at(SETTLED, -step)) / (2 * step)
    assert abs(numeric) > 1e-3
    # Gauss-Newton leaves second derivatives out.
    share = 0.3 if mode == "implicit_gauss_newton" else 0.02
    assert abs(float(gradient) - numeric) < 1e-3 + share * abs(numeric)


def test_implicit_gradients_pass_through_a_next_view_that_shows_the_car_elsewhere() -> None:
    prior, code = ellipsoid_prior(), torch.tensor([[0.9, -0.4, 0.5]], dtype=torch.float64)
    seen = [street(prior, [(x, CAMERA_HEIGHT_M, 8.0)], [heading], code) for x, heading in ((-1.3, 0.6), (-0.7, 0.7))]
    frames = joined_frames([view.frames for view in seen])
    # Pictures so smooth that a minimum sits on no kink between pixels.
    left, right = (gaussian_blur2d(x, (31, 31), (6.0, 6.0)) for x in (frames.images_left, frames.images_right))
    boxes = disturbed(joined_detections([view.detections for view in seen], (120, 160)))
    boxes = replace(boxes, mask_left=boxes.mask_left.dense().clamp(0.2, 0.8), track_id=torch.tensor([5, 5]))
    direction = 0.1 * torch.randn(left.shape, generator=torch.Generator().manual_seed(5)).double()
    # The picture of the later view alone changes.
    direction[0] = 0

    def summary_at(config: RefinerConfig, by: Tensor | float) -> Tensor:
        moved = replace(frames, images_left=left + by * direction, images_right=right)
        result = DirectShapeRefiner(prior, config)(moved, boxes)
        assert result.cost_after[0, result.term_names.index("next_view")] > 0.01
        return summary(result)

    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(summary_at(with_mode("implicit"), by), by)
    step = 1e-6
    numeric = float(summary_at(SETTLED, step) - summary_at(SETTLED, -step)) / (2 * step)
    assert abs(numeric) > 1e-2
    assert abs(float(gradient) - numeric) < 0.02 * abs(numeric)


def test_two_views_of_a_track_in_one_frame_are_refused() -> None:
    _, detections, _ = drive()
    with pytest.raises(InputError, match="track 5 in rows 0 and 1 of frame 0"):
        replace(detections, track_id=torch.tensor([5, 5, 1, 1, 2, 3]))


@pytest.mark.parametrize(
    ("unknowns", "of_track"), [(("pose", "shape"), "both"), (("both", "both"), "both"), (("pose", "pose"), "pose")]
)
def test_a_track_moves_all_that_some_stage_moves(unknowns: tuple[Any, ...], of_track: str) -> None:
    stages = [StageConfig(max_iterations=number, unknowns=each) for number, each in enumerate(unknowns)]
    assert share.stage_of_tracks(stages) == StageConfig(max_iterations=2, unknowns=of_track)  # type: ignore[arg-type]


def test_a_term_of_ones_own_has_another_name_than_those_of_a_track() -> None:
    prior, (frames, detections, _) = ellipsoid_prior(), drive()
    detections = replace(detections, track_id=torch.tensor([0, 1] * 3))

    def named(name: str) -> DirectShapeRefiner:
        def user(*scene: Any) -> PriorTerm:
            return PriorTerm(name, 1.0, scene[2], height_prior, 1, (POSE,))

        return DirectShapeRefiner(prior, QUICK, [user])

    assert named("user")(frames, detections).term_names[-1] == "user"
    for name in ("path", "acceleration", "next_view"):
        with pytest.raises(InputError, match=f"extra term '{name}': names: expected names that no column of a track"):
            named(name)(frames, detections)


def test_a_view_that_is_not_trusted_alone_is_where_its_track_makes_it_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    together = of_tracks(*[0, 1] * 3)
    doubt(monkeypatch, alone=2)
    assert refined(drive()[1]).status[2] == Status.not_trusted
    assert_same(refined(drive()[1], [0, 1] * 3), together)


@pytest.mark.parametrize("in_track", [(2,), (0, 4)])
def test_a_view_that_is_not_trusted_in_good_company_leaves_the_track_as_without_it(
    monkeypatch: pytest.MonkeyPatch, in_track: tuple[int, ...]
) -> None:
    """It is not trusted in its track, or alone is."""
    _, detections, _ = drive()
    without = of_tracks(0, 1, -1, 1, 0, 1)
    doubt(monkeypatch, *in_track, alone=2)
    result = refined(detections, [0, 1] * 3)
    assert result.status[2] == Status.not_trusted
    assert torch.equal(result.T_cam_obj[2], detections.T_cam_obj[2])
    others = [0, 1, 3, 4, 5]
    for name in ("T_cam_obj", "code", "covariance", "cost_after"):
        assert torch.equal(getattr(result, name)[others], getattr(without, name)[others]), name


def test_a_view_that_is_not_trusted_alone_splits_no_track(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(same_car, "_MOST_EVIDENCE", 3.0)
    _, detections, _ = drive(contrast=2.5)
    doubt(monkeypatch, alone=4)
    assert refined(detections, [0, 1, 0, 1, 1, 0], contrast=2.5).track_part.tolist() == [0, 0, 0, 0, 0, -1]


def test_a_view_that_is_not_trusted_in_its_track_keeps_what_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    _, detections, _ = drive()
    alone, trusted = by_themselves(), of_tracks(*[0, 1] * 3)
    doubt(monkeypatch, 2)
    result = refined(detections, [0, 1] * 3)
    others = [0, 1, 3, 4, 5]
    for name, values in result.state_dict().items():
        if name in ("T_cam_obj", "code", "covariance", "cost_after", "quality.mask_iou_left"):
            # A track has columns of costs more.
            own = values[2, : len(alone.term_names)] if name == "cost_after" else values[2]
            assert torch.equal(own, alone.state_dict()[name][2]), name
            assert torch.equal(values[others], trusted.state_dict()[name][others]), name
    assert all(status.is_refined for status in result.status)


def test_a_view_that_leaves_midway_leaves_the_track_as_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    _, detections, _ = drive()
    without = of_tracks(0, 1, -1, 1, 0, 1)
    minimise = refinements.minimise

    def failing(problem: CarProblem, *others: Any) -> CarMinimum[AnyState]:
        minimum = minimise(problem, *others)
        if not isinstance(problem.sharing, Groups) or len(minimum.status) < 6:
            return minimum
        return replace(minimum, status=minimum.status.index_fill(0, torch.tensor([2]), Status.singular.code))

    monkeypatch.setattr(refinements, "minimise", failing)
    assert_same(refined(detections, [0, 1] * 3), without)


def test_a_view_whose_track_has_no_other_that_is_trusted_has_a_shape_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, detections, _ = drive()
    doubt(monkeypatch, 1, num_rows=4)
    assert refined(detections, [0, -1, 0, 1, -1, 1]).track_part.tolist() == [-1, -1, -1, 0, -1, 0]
