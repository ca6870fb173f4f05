"""A view compared with the next one of its track has right derivatives and pixels, and improves results."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import CAMERA_HEIGHT_M, Street, joined_detections, joined_frames, masked, street
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.field import field_of
from directshape_torch.terms.photometric import Brightness, PhotometricEvidence
from directshape_torch.terms.term import Prepared
from directshape_torch.tracks.next_view import NextView, NextViewEvidence, NextViews
from directshape_torch.tracks.state import TrackState

# Three views of two cars.
NEXT = torch.tensor([2, 3, 4, 5, 4, 5])
FOCAL_PX = 150.0
CODE = torch.tensor([[0.9, -0.4, 0.5], [-0.8, 0.3, -0.4]], dtype=torch.float64)


@cache
def drive() -> tuple[FrameBatch, Detections]:
    """A car that turns and one that comes nearer, with their true boxes, which must not be changed."""
    height = CAMERA_HEIGHT_M
    seen: list[Street] = [
        street(
            ellipsoid_prior(),
            [(-1.3, height, 8.0 + 0.4 * n), (3.0, height, 11.0 - 0.4 * n)],
            [0.6 + 0.15 * n, -1.2],
            CODE,
        )
        for n in range(3)
    ]
    return joined_frames([view.frames for view in seen]), joined_detections(
        [view.detections for view in seen], (120, 160)
    )


def at_truth(
    frames: FrameBatch, detections: Detections, num_offsets: int = 0, config: RefinerConfig = DEFAULT
) -> tuple[CarProblem, TrackState]:
    """The problem of the next views only, and the true state."""
    detections = replace(detections, offset_sigma_px=torch.full((6,), 0.3).double() if num_offsets else None)
    problem, state = DirectShapeRefiner(ellipsoid_prior(), config).problem(frames, detections)
    stereo = next(each for each in problem.evidence if isinstance(each, PhotometricEvidence))
    evidence = NextViewEvidence(1.0, stereo, NextViews.of(stereo.cars, NEXT))
    path = state.code.new_zeros(6, 9)
    views = TrackState(state.T_obj_cam, CODE.repeat(3, 1), state.offset_px, path, state.T_obj_cam[NEXT][:, None])
    return replace(problem, evidence=(evidence,)), views


def begun(problem: CarProblem, state: TrackState, stage: int = 1) -> tuple[NextView, Prepared]:
    prepared = problem.prepare(state)
    (term,) = problem.begin(stage, prepared).terms
    assert isinstance(term, NextView)
    return term, prepared


def disturbed(state: TrackState) -> TrackState:
    """The state moved by centimetres; the copied poses of the next views are moved by other amounts."""
    generator = torch.Generator().manual_seed(3)
    delta = torch.randn(6, state.unknowns.size, generator=generator, dtype=torch.float64)
    return state.unknowns.retract(state, 0.01 * delta)


def test_true_poses_and_shapes_explain_the_next_view() -> None:
    problem, state = at_truth(*drive())
    term, prepared = begun(problem, state)
    counts = term.row_weight > 0

    def mean_residual(at: TrackState) -> float:
        residual = term.linear(field_of(problem.prior.bind(at.code)), at, term.anchor(prepared)).residual
        return float(residual[counts].abs().mean())

    step = torch.zeros(6, state.unknowns.size, dtype=torch.float64)
    step[:, 0] = 0.1
    assert mean_residual(state) < 0.3 * mean_residual(state.unknowns.retract(state, step))
    # Both cars as one body, seen by the next camera as it was: nothing tells.
    away = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    assert mean_residual(state._replace(T_obj_next=away @ state.T_obj_next)) > 3 * mean_residual(state)


def test_pixels_count_that_the_next_view_shows() -> None:
    frames, detections = drive()
    problem, state = at_truth(frames, detections)
    term, _ = begun(problem, state)
    owner, weight = term.blocks.owner, term.row_weight[..., 0]
    stereo = term.stereo.pixel_set.rows.pixel_weight
    seen = torch.tensor(
        [float((weight[owner == car] > 0).sum() / (stereo[owner == car] > 0).sum()) for car in range(6)]
    )
    assert (seen[:4] > 0.9).all()
    assert seen[4:].tolist() == [0, 0]
    # Half of the car hidden in the next view, by whatever takes it off its mask.
    mask = detections.mask_left.dense()
    u = int((mask[2].sum(dim=0) > 0).nonzero().double().mean())
    mask[2, :, :u] = 0
    hidden, _ = begun(at_truth(frames, replace(detections, mask_left=mask))[0], state)
    count, before = (int((x.row_weight[x.blocks.owner == 0] > 0).sum()) for x in (hidden, term))
    assert 0.2 * before < count < 0.8 * before
    # What it cost less is not won: a mean over all pixels of the view.
    torch.testing.assert_close(hidden.block_weight[:1], term.block_weight[:1])


def test_one_car_looks_alike_in_the_next_view_a_little_beside_itself_too() -> None:
    problem, state = at_truth(*drive())
    term, prepared = begun(problem, state)
    alike, count = term.likeness(prepared)
    assert (alike[:4] > 0.97).all()
    assert (alike[4:] == -1).all()
    assert count.tolist() == [float((term.row_weight[term.blocks.owner == car] > 0).sum()) for car in range(6)]
    depth = se3.inverse(state.T_obj_cam)[NEXT, 2, 3]
    for shift_px, least, most in ((2.5, 0.9, 1.0), (9.0, -1.0, 0.8)):
        aside = torch.zeros(6, 6, dtype=torch.float64)
        aside[:, 0] = shift_px * depth / FOCAL_PX
        beside, _ = term.likeness(
            problem.prepare(state._replace(T_obj_next=state.T_obj_next @ se3.exp(aside)[:, None]))
        )
        assert (beside[:4] > least).all()
        assert (beside[:4] < most).all()


def test_a_side_that_has_turned_away_does_not_count() -> None:
    frames, detections = drive()
    # Nothing but the way that the surface faces keeps its pixels out.
    everywhere = torch.ones_like(detections.mask_left.dense())
    masks = torch.where(torch.arange(6)[:, None, None] == 2, everywhere, detections.mask_left.dense())
    problem, state = at_truth(frames, replace(detections, mask_left=masks))
    half_turn = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, torch.pi, 0.0], dtype=torch.float64))
    turned = state._replace(T_obj_next=half_turn @ state.T_obj_next)
    counts = [(x.row_weight[x.blocks.owner == 0] > 0).sum() for x, _ in (begun(problem, state), begun(problem, turned))]
    assert counts[1] < 0.3 * counts[0]


def test_a_next_view_without_a_left_mask_shows_nothing() -> None:
    frames, detections = drive()
    detections = masked(detections, torch.arange(len(detections)) != 2)
    term, _ = begun(*at_truth(frames, detections))
    counted = term.row_weight[..., 0].sum(dim=1)
    assert (counted[term.blocks.owner == 0] == 0).all()
    assert (counted[term.blocks.owner == 1] > 0).any()


def shifted(values: Tensor, row: int, by: int) -> Tensor:
    """Values (N, ..., W) of which one row has lost its first columns, padded at the end."""
    values = values.clone()
    values[row] = torch.nn.functional.pad(values[row, ..., by:], (0, by))
    return values


def test_the_next_frame_may_have_another_camera_and_size() -> None:
    frames, detections = drive()
    whole, prepared = begun(*at_truth(frames, detections))
    K_left, K_right = frames.camera.K_left.clone(), frames.camera.K_right.clone()
    K_left[1, 0, 2] -= 8
    K_right[1, 0, 2] -= 8
    images = {name: shifted(getattr(frames, name), 1, 8) for name in ("images_left", "images_right")}
    sizes = frames.sizes - torch.tensor([[0, 0], [0, 8], [0, 0]])
    cut = replace(frames, camera=replace(frames.camera, K_left=K_left, K_right=K_right), sizes=sizes, **images)
    masks = {name: getattr(detections, name).dense() for name in ("mask_left", "mask_right")}
    masks = {name: shifted(shifted(mask, 2, 8), 3, 8) for name, mask in masks.items()}
    term, there = begun(*at_truth(cut, replace(detections, **masks)))
    of_first = [x.blocks.owner < 2 for x in (whole, term)]
    residuals = [
        x.linear(s.field, s.state, x.anchor(s)).residual[rows]
        for x, s, rows in ((whole, prepared, of_first[0]), (term, there, of_first[1]))
    ]
    torch.testing.assert_close(residuals[1], residuals[0])
    assert torch.equal(term.row_weight[of_first[1]], whole.row_weight[of_first[0]])


def test_the_exposure_of_the_next_frame_does_not_matter() -> None:
    frames, detections = drive()
    darker = frames.images_left.clone()
    darker[1] *= 0.9
    greys = [begun(*at_truth(f, detections))[0] for f in (frames, replace(frames, images_left=darker))]
    ratio = (greys[1].image.grey / greys[0].image.grey)[greys[0].blocks.owner == 0]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.9), rtol=0.01, atol=0)


@pytest.mark.parametrize("brightness", ["none", "gain"])
def test_what_images_change_is_differentiable(brightness: Brightness) -> None:
    frames, detections = drive()
    config = replace(DEFAULT, photometric=replace(DEFAULT.photometric, brightness=brightness))
    noise = torch.randn(frames.images_left.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)

    def slopes(by: Tensor | float) -> Tensor:
        changed = replace(frames, images_left=frames.images_left + 0.02 * by * noise)
        problem, state = at_truth(changed, detections, config=config)
        with torch.no_grad():
            prepared = problem.prepare(state)
        # The state at which a stage begins is a constant.
        stage = problem.begin(1, prepared)
        return stage.linearise_differentiably(disturbed(state)).gradient.square().sum()

    by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(slopes(by), by)
    with torch.no_grad():
        numeric = (slopes(1e-6) - slopes(-1e-6)) / 2e-6
    assert abs(numeric) > 1e-3
    torch.testing.assert_close(slope, numeric, rtol=1e-3, atol=0)
