"""Occlusion (order, hidden pixels, crops) agrees with hand-made scenes and a slow reference."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reference.occlusion import hidden_pixels as one_by_one
from torch import Tensor

from directshape_torch.config import OcclusionOrder
from directshape_torch.observation.occlusion import occlusion_map
from directshape_torch.scene.detections import Detections, Occluders
from directshape_torch.scene.frames import Side

HEIGHT, WIDTH = 20, 30


def scene(
    depth_m: list[float],
    bottom_v: list[float],
    masks: Tensor | None = None,
    frame: list[int] | None = None,
    occluders: Occluders | None = None,
) -> Detections:
    count = len(depth_m)
    T_cam_obj = torch.eye(4).repeat(count, 1, 1)
    T_cam_obj[:, 2, 3] = torch.tensor(depth_m)
    box = torch.zeros(count, 4)
    box[:, 3] = torch.tensor(bottom_v)
    masks = torch.zeros(count, HEIGHT, WIDTH) if masks is None else masks
    return Detections(
        frame_index=torch.tensor(frame or [0] * count, dtype=torch.long),
        T_cam_obj=T_cam_obj,
        dimensions_hwl=torch.ones(count, 3),
        box_2d=box,
        score=torch.ones(count),
        mask_left=masks,
        mask_right=masks.roll(3, dims=2),
        occluders=occluders,
    )


def squares(*boxes: tuple[int, int, int, int]) -> Tensor:
    masks = torch.zeros(len(boxes), HEIGHT, WIDTH)
    for mask, (u0, v0, u1, v1) in zip(masks, boxes, strict=True):
        mask[v0:v1, u0:u1] = 1.0
    return masks


def all_pixels(count: int) -> tuple[Tensor, Tensor]:
    pixels = torch.cartesian_prod(torch.arange(HEIGHT), torch.arange(WIDTH)).flip(1)
    return torch.arange(count).repeat_interleave(len(pixels)), pixels.repeat(count, 1)


def hidden_pixels(detections: Detections, side: Side, object_index: Tensor, uv: Tensor) -> Tensor:
    """Whether pixels (P, 2) of objects (P,) are hidden, after a check that the reference agrees."""
    hidden = occlusion_map(detections, side).at(object_index, uv)
    assert torch.equal(hidden, one_by_one(detections, side, object_index, uv))
    return hidden


def instances_in_front(detections: Detections, side: Side, order: OcclusionOrder = "depth") -> Tensor:
    """Which instance hides which detection (B + M, B), from masks in which each covers a pixel of its own."""
    others, count = detections.occluders, len(detections)
    num_instances = count + (0 if others is None else len(others.frame_index))
    masks = squares(*((i, 0, i + 1, 1) for i in range(num_instances)))
    if others is not None:
        others = replace(others, mask_left=masks[count:], mask_right=masks[count:])
    alone = replace(detections, mask_left=masks[:count], mask_right=masks[:count], occluders=others)
    uv = torch.stack([torch.arange(num_instances), torch.zeros(num_instances, dtype=torch.long)], dim=1)
    return occlusion_map(alone, side, order).at(torch.arange(count), uv[:, None].expand(-1, count, 2))


def test_depth_and_box_order_disagree() -> None:
    detections = scene([10.0, 20.0], [150.0, 180.0])
    assert instances_in_front(detections, "left", "depth").tolist() == [[False, True], [False, False]]
    assert instances_in_front(detections, "left", "box_bottom").tolist() == [[False, False], [True, False]]


@pytest.mark.parametrize("unknown", [torch.nan, -3.0])
def test_unknown_depth_falls_back_to_the_box(unknown: float) -> None:
    # The pair 0, 1 has depths; 2 goes by the boxes: it is in front of 0 (bottom 150), behind 1 (180).
    in_front = instances_in_front(scene([10.0, 20.0, unknown], [150.0, 180.0, 160.0]), "left")
    assert in_front.nonzero().tolist() == [[0, 1], [2, 0]]


def test_equals_other_frames_and_absent_masks_hide_nothing() -> None:
    assert not instances_in_front(scene([10.0, 10.0], [1.0, 2.0]), "left").any()
    assert not instances_in_front(scene([10.0, 20.0], [2.0, 1.0], frame=[0, 1]), "left").any()
    both = scene([10.0, 20.0], [2.0, 1.0], squares((0, 0, 4, 4), (0, 0, 4, 4)))
    blind = replace(both, mask_left=both.mask_left.where(torch.tensor([False, True])))
    index, uv = all_pixels(2)
    assert hidden_pixels(both, "left", index, uv).any()
    assert not hidden_pixels(blind, "left", index, uv).any()


def test_hidden_pixels_are_the_mask_in_front() -> None:
    masks = squares((5, 5, 15, 15), (10, 8, 25, 18))
    detections = scene([10.0, 20.0], [15.0, 18.0], masks)
    object_index, uv = all_pixels(2)
    for side, expected in (("left", masks[0]), ("right", masks[0].roll(3, dims=1))):
        hidden = hidden_pixels(detections, side, object_index, uv).reshape(2, HEIGHT, WIDTH)
        assert not hidden[0].any()
        assert torch.equal(hidden[1], expected > 0.5)


def test_half_probability_does_not_hide() -> None:
    masks = squares((0, 0, 4, 4), (0, 0, 4, 4))
    masks[0] *= 0.5
    masks[0, 1, 2] = 0.51
    object_index, uv = all_pixels(2)
    hidden = hidden_pixels(scene([5.0, 9.0], [0.0, 0.0], masks), "left", object_index, uv)
    assert uv[hidden].tolist() == [[2, 1]]


def test_other_classes_hide() -> None:
    pedestrian = squares((2, 2, 6, 12))
    occluders = Occluders(
        frame_index=torch.tensor([0]),
        mask_left=pedestrian > 0.5,  # bool beside the cars' probabilities
        mask_right=pedestrian > 0.5,
        depth_m=torch.tensor([torch.nan]),
        bottom_v=torch.tensor([17.0]),
    )
    detections = scene([10.0, 20.0], [18.0, 15.0], squares((0, 0, 1, 1), (0, 0, 30, 20)), occluders=occluders)
    assert instances_in_front(detections, "left").nonzero().tolist() == [[0, 1], [2, 1]]
    hidden = hidden_pixels(
        detections, "left", torch.tensor([1, 1, 1, 0]), torch.tensor([[2, 2], [6, 2], [0, 0], [2, 2]])
    )
    assert hidden.tolist() == [True, False, True, False]


def test_what_stands_in_front_has_no_gradient() -> None:
    depth_m, bottom_v = (torch.tensor([x], requires_grad=True) for x in (5.0, 17.0))
    others = Occluders(torch.tensor([0]), squares((2, 2, 6, 12)), squares((2, 2, 6, 12)), depth_m, bottom_v)
    detections = scene([10.0, 20.0], [18.0, 15.0], squares((0, 0, 1, 1), (0, 0, 30, 20)), occluders=others)
    detections.box_2d.requires_grad_()
    hidden = occlusion_map(detections, "left")
    assert not hidden.covering.requires_grad
    assert not hidden.in_front.requires_grad
    assert hidden.at(torch.tensor(0), torch.tensor([3, 3])).item()


def test_random_scenes_equal_the_reference_in_any_order() -> None:
    generator = torch.Generator().manual_seed(0)
    count = 7
    masks = (torch.rand(count, HEIGHT, WIDTH, generator=generator) > 0.7).float()
    depth = [12.0, torch.nan, 9.0, 30.0, 8.0, 15.0, -1.0]
    frame = [0, 0, 1, 0, 1, 0, 0]
    detections = scene(depth, [100.0, 90.0, 95.0, 80.0, 99.0, 97.0, 85.0], masks, frame)
    object_index, uv = all_pixels(count)
    hidden = hidden_pixels(detections, "left", object_index, uv).reshape(count, HEIGHT, WIDTH)
    permutation = torch.tensor([3, 0, 6, 2, 5, 1, 4])
    permuted = scene(
        [depth[i] for i in permutation],
        [[100.0, 90.0, 95.0, 80.0, 99.0, 97.0, 85.0][i] for i in permutation],
        masks[permutation],
        [frame[i] for i in permutation],
    )
    assert torch.equal(hidden_pixels(permuted, "left", object_index, uv).reshape_as(hidden), hidden[permutation])


def test_points_between_pixels() -> None:
    detections = scene([10.0, 20.0, 30.0], [15.0, 18.0, 9.0], squares((5, 5, 15, 15), (10, 8, 25, 18), (0, 0, 30, 20)))
    hidden = occlusion_map(detections, "left")
    # Nearest pixel of a real-valued point; what is no number is not hidden.
    uv = torch.tensor([[14.4, 14.4], [14.6, 14.4], [4.0, 5.0], [torch.nan, 9.0], [torch.inf, 9.0]])
    assert hidden.at(torch.tensor(1), uv).tolist() == [True, False, False, False, False]
    assert hidden.at(torch.tensor([[0], [1]]), uv.expand(2, 5, 2)).shape == (2, 5)


def test_outside_the_image_and_no_objects() -> None:
    detections = scene([10.0, 20.0], [0.0, 0.0], torch.ones(2, HEIGHT, WIDTH))
    uv = torch.tensor([[-1, 0], [0, -1], [WIDTH, 0], [0, HEIGHT], [WIDTH - 1, HEIGHT - 1]])
    hidden = hidden_pixels(detections, "left", torch.ones(5, dtype=torch.long), uv)
    assert hidden.tolist() == [False, False, False, False, True]
    nobody = scene([], [], torch.zeros(0, HEIGHT, WIDTH))
    none = torch.zeros(0, dtype=torch.long)
    assert hidden_pixels(nobody, "left", none, none.reshape(0, 2)).shape == (0,)
    assert occlusion_map(nobody, "left").at(none, none.reshape(0, 2)).shape == (0,)
