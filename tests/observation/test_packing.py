"""Packed and sampled pixels agree with a whole-frame form over random scenes and with cases by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.occlusion import hidden_pixels
from reference.pixel_sampling import gradient_magnitude, select_pixels
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.ground_plane import GroundPlane
from directshape_torch.observation.packing import Observation, car_regions, pack_pixels, region_boxes, sampled_pixels
from directshape_torch.scene.detections import Detections, Occluders
from directshape_torch.scene.frames import FrameBatch, Side
from directshape_torch.scene.masks import MaskCrops
from tests.helpers.synthetic_scene import stereo_camera

PADDING = 0.77  # grey that must not matter


def whole_frame_side(frames: FrameBatch, d: Detections, side: Side, regions: Tensor, config: SamplingConfig) -> Any:
    """Object, pixel, foreground and gradient of the chosen pixels of one image, by reading all pixels."""
    images, masks = (
        (frames.images_left, d.mask_left.dense()) if side == "left" else (frames.images_right, d.mask_right.dense())
    )  # fmt: skip
    magnitude = gradient_magnitude(images, frames.sizes)
    mode = config.mode if side == "left" else config.mode_right
    object_index, uv = select_pixels(magnitude, d.frame_index, regions, mode, config)
    if config.occlusion:
        visible = ~hidden_pixels(d, side, object_index, uv, config.occlusion_order)
        object_index, uv = object_index[visible], uv[visible]
    u, v = uv.unbind(-1)
    return object_index, uv, masks[object_index, v, u], magnitude[d.frame_index[object_index], v, u]


def random_masks(generator: torch.Generator, frame: Tensor, sizes: Tensor, shape: tuple[int, int]) -> Tensor:
    """Rectangles of random probabilities with holes, often over a border, some empty."""
    masks = torch.zeros(len(frame), *shape)
    for mask, (height, width) in zip(masks, sizes[frame].tolist(), strict=True):
        u, v = (int(torch.randint(-20, n, (1,), generator=generator)) for n in (width, height))
        w, h = (int(torch.randint(1, n, (1,), generator=generator)) for n in (60, 45))
        patch = mask[max(v, 0) : min(max(v + h, 0), height), max(u, 0) : min(max(u + w, 0), width)]
        patch[:] = torch.rand(patch.shape, generator=generator) ** 0.3
    return masks


def random_scene(seed: int, count: int, num_frames: int = 3, others: int = 4) -> tuple[FrameBatch, Detections]:
    """Frames of different sizes, padded, with cars at random places."""
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.stack([torch.randint(40, n, (num_frames,), generator=generator) for n in (110, 190)], dim=1)
    shape = tuple(sizes.amax(dim=0).tolist()) if num_frames else (50, 60)
    images = torch.full((2, num_frames, 3, *shape), PADDING)
    for frame, (height, width) in enumerate(sizes.tolist()):
        noise = torch.rand(2, 3, height, width, generator=generator)
        images[:, frame, :, :height, :width] = noise * torch.rand(2, 3, height, 1, generator=generator)
    frame_index = torch.randint(max(num_frames, 1), (count,), generator=generator)
    camera = stereo_camera(150, 100, 120.0, torch.float32)
    camera = replace(
        camera, **{n: getattr(camera, n).expand(num_frames, *[-1] * (getattr(camera, n).ndim - 1)) for n in
                   ("K_left", "K_right", "T_right_cam", "t_cam_ref")}
    )  # fmt: skip
    ground = GroundPlane.from_camera_height(1.65, num_frames)
    frames = FrameBatch(images[0], images[1], sizes, camera, ground, tuple(f"{n:06d}" for n in range(num_frames)))
    location = torch.rand(count, 3, generator=generator) * torch.tensor([8.0, 0.0, 30.0]) + torch.tensor([-4, 1.6, 4.0])
    low = torch.rand(count, 2, generator=generator) * 150 - 30
    frame_of_other = torch.randint(max(num_frames, 1), (others,), generator=generator)
    depth = torch.rand(others, generator=generator) * 30
    occluders = Occluders(
        frame_index=frame_of_other,
        mask_left=random_masks(generator, frame_of_other, sizes, shape) > 0.5,
        mask_right=random_masks(generator, frame_of_other, sizes, shape) > 0.5,
        depth_m=torch.where(torch.rand(others, generator=generator) > 0.5, depth, torch.nan),
        bottom_v=torch.rand(others, generator=generator) * 100,
    )
    present = torch.rand(2, count, generator=generator) > 0.1
    detections = Detections(
        frame_index=frame_index,
        T_cam_obj=pose_from_kitti(location, torch.rand(count, generator=generator)),
        dimensions_hwl=torch.ones(count, 3),
        box_2d=torch.cat([low, low + torch.rand(count, 2, generator=generator) * 60], dim=1),
        score=torch.ones(count),
        mask_left=MaskCrops.of(random_masks(generator, frame_index, sizes, shape), present[0]),
        mask_right=MaskCrops.of(random_masks(generator, frame_index, sizes, shape), present[1]),
        occluders=occluders if others else None,
    )
    return frames, detections


def assert_equal_to_whole_frames(frames: FrameBatch, d: Detections, config: SamplingConfig) -> Observation:
    seen = pack_pixels(frames, d, config)
    for side, pixels, regions in zip(("left", "right"), (seen.left, seen.right), car_regions(frames, d), strict=True):
        object_index, uv, foreground, magnitude = whole_frame_side(frames, d, side, regions, config)
        assert torch.equal(pixels.object_index, object_index)
        assert torch.equal(pixels.uv, uv.to(pixels.uv.dtype))
        assert torch.equal(pixels.foreground, foreground)
        assert torch.equal(pixels.gradient_magnitude, magnitude)
    return seen


@pytest.mark.parametrize("seed", range(2))
def test_random_scenes_equal_the_whole_frame_form(seed: int) -> None:
    frames, detections = random_scene(seed, count=9)
    seen = assert_equal_to_whole_frames(frames, detections, SamplingConfig())
    assert len(seen.left) > 100
    assert torch.equal(seen.mask_areas[:, 0], detections.mask_left.areas)


@pytest.mark.parametrize("mode", ["adaptive", "uniform", "dense"])
@pytest.mark.parametrize("order", ["depth", "box_bottom", None])
def test_every_mode_and_order_equals_the_whole_frame_form(mode: str, order: str | None) -> None:
    others = {"adaptive": "uniform", "uniform": "dense", "dense": "adaptive"}
    config = SamplingConfig(
        mode=mode, mode_right=others[mode], occlusion=order is not None, occlusion_order=order or "depth"
    )
    frames, detections = random_scene(11, count=7)
    assert_equal_to_whole_frames(frames, detections, config)


@pytest.mark.parametrize("num_frames", [0, 2])
@pytest.mark.parametrize("others", [0, 3])
def test_no_cars(num_frames: int, others: int) -> None:
    frames, detections = random_scene(13, count=0, num_frames=num_frames, others=others if num_frames else 0)
    seen = assert_equal_to_whole_frames(frames, detections, SamplingConfig())
    assert len(seen.left) == len(seen.right) == 0
    assert seen.mask_areas.shape == (0, 2)


def test_gradients_reach_images_and_masks() -> None:
    frames, detections = random_scene(5, count=4)
    attached = frames.images_left.clone().requires_grad_()
    mask = detections.mask_right.dense().requires_grad_()
    seen = pack_pixels(replace(frames, images_left=attached), replace(detections, mask_right=mask), SamplingConfig())
    (seen.left.gradient_magnitude.sum() + seen.right.foreground.sum()).backward()
    reference = frames.images_left.clone().requires_grad_()
    magnitude = gradient_magnitude(reference, frames.sizes)
    u, v = seen.left.uv.long().unbind(-1)
    magnitude[detections.frame_index[seen.left.object_index], v, u].sum().backward()
    torch.testing.assert_close(attached.grad, reference.grad)
    assert mask.grad is not None
    assert mask.grad.sum() == len(seen.right)


def boxes_of(mask_box: tuple[int, int, int, int] | None, box: list[float]) -> list[int]:
    mask_boxes = torch.zeros(1, 4, dtype=torch.long)
    if mask_box is not None:
        u0, v0, u1, v1 = mask_box
        mask_boxes[0] = torch.tensor([u0, v0, u1 + 1, v1 + 1])
    result: list[int] = region_boxes(torch.tensor([box]), mask_boxes, torch.tensor([[100, 200]]))[0].tolist()
    return result


def test_region_joins_mask_and_box_and_grows() -> None:
    # Joined: u 40..100, v 30..50. Margins: 10 % of 60 = 6 horizontally, 4 at least vertically. Half open: + 1.
    assert boxes_of((40, 35, 70, 50), [60.0, 30.0, 100.0, 45.0]) == [34, 26, 107, 55]
    assert boxes_of(None, [60.0, 30.0, 100.5, 45.0]) == [55, 26, 106, 50]


def test_region_is_clipped_and_may_be_empty() -> None:
    assert boxes_of(None, [-500.0, -20.0, 10.0, 40.0]) == [0, 0, 15, 45]
    assert boxes_of(None, [150.0, 60.0, 900.0, 300.0]) == [145, 56, 200, 100]
    for nowhere in ([-50.0, 0.0, -1.0, 9.0], [200.0, 0.0, 230.0, 9.0], [torch.nan] * 4, [20.0, 20.0, 10.0, 30.0]):
        assert boxes_of(None, nowhere) == [0, 0, 0, 0]
        assert boxes_of((40, 40, 60, 60), nowhere) == [36, 36, 65, 65]


SIZES = torch.tensor([[70, 150], [64, 101]])


def noise(seed: int) -> Tensor:
    """Two padded frames of noise."""
    return torch.rand(2, 3, 70, 150, generator=torch.Generator().manual_seed(seed))


@given(width=st.integers(0, 300), height=st.integers(0, 200), wanted=st.integers(1, 900))
def test_even_pixels_lie_in_the_region_each_once_and_about_as_many_as_are_wanted(
    width: int, height: int, wanted: int
) -> None:
    settings = SamplingConfig(min_pixels=wanted, max_pixels=wanted)
    region = torch.tensor([[5, 6, 5 + width, 6 + height]])
    _, uv = sampled_pixels(noise(0), SIZES, torch.tensor([0]), region, "uniform", settings)
    assert ((uv >= region[:, :2]) & (uv < region[:, 2:])).all()
    assert len(uv.unique(dim=0)) == len(uv)
    if min(width, height) ** 2 > 100 * max(1, width * height / wanted):
        assert len(uv) == pytest.approx(min(wanted, width * height), rel=0.25)


def test_strong_gradients_are_found() -> None:
    images = torch.zeros(1, 3, 40, 40)
    images[..., 20:] = 1.0  # an edge between columns 19 and 20
    settings = SamplingConfig(min_pixels=4, max_pixels=4)
    arguments = torch.tensor([[40, 40]]), torch.tensor([0]), torch.tensor([[4, 4, 36, 36]]), "adaptive", settings
    # In both columns of cells the pixels beside the edge, the uppermost of equals.
    assert sampled_pixels(images, *arguments)[1].tolist() == [[19, 4], [20, 4], [19, 20], [20, 20]]
    assert torch.equal(sampled_pixels(images.double(), *arguments)[1], sampled_pixels(images, *arguments)[1])


def test_a_nan_image_still_gives_pixels_and_touches_no_other_frame() -> None:
    images = noise(3)
    spoiled = images.clone()
    spoiled[0] = torch.nan
    arguments = SIZES, torch.tensor([0, 1]), torch.tensor([[0, 0, 50, 50]] * 2), "adaptive", SamplingConfig()
    (of, uv), (clean_of, clean_uv) = sampled_pixels(spoiled, *arguments), sampled_pixels(images, *arguments)
    assert (of == 0).any()
    assert torch.equal(uv[of == 1], clean_uv[clean_of == 1])
