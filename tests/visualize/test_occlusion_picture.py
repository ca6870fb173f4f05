"""Pictures of occlusion: their size, their colours where the scene is known, and clear errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.scene import Detections, FrameBatch, GroundPlane
from directshape_torch.visualize.inspection.sampling_figure import (
    OCCLUDER_COLOURS,
    PANEL_GAP_PX,
    occlusion_picture,
)

REGIONS = torch.tensor([[0, 0, 20, 20], [10, 10, 40, 30], [0, 0, 0, 0]])


def two_cars() -> tuple[FrameBatch, Detections]:
    """A grey image, a near car on pixels 0..19, and a far one behind it; a third has no region."""
    K = torch.tensor([[[100.0, 0.0, 30.0], [0.0, 100.0, 20.0], [0.0, 0.0, 1.0]]])
    T_right_cam = torch.eye(4)[None].clone()
    T_right_cam[:, 0, 3] = -0.5
    camera = StereoCamera(K, K, T_right_cam, torch.zeros(1, 3))
    images = torch.full((1, 3, 40, 60), 0.5)
    frames = FrameBatch(
        images, images, torch.tensor([[40, 60]]), camera, GroundPlane.from_camera_height(1.6), ("000000",)
    )
    masks = torch.zeros(3, 40, 60)
    masks[0, :20, :20] = 1
    masks[1, 10:30, 10:40] = 1
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 2, 3] = torch.tensor([10.0, 20.0, 30.0])
    boxes, present = REGIONS.float(), torch.ones(3, dtype=torch.bool)
    detections = Detections(
        torch.zeros(3, dtype=torch.long), poses, torch.ones(3, 3), boxes, torch.ones(3), masks, masks, present, present
    )
    return frames, detections


def test_occlusion_picture_shows_three_panels() -> None:
    frames, detections = two_cars()
    scale = 2
    picture = occlusion_picture(frames, detections, REGIONS, 1, scale=scale)
    # The view is the region with 8 + 30 // 6 = 13 px around it, within the image: u 0..53, v 0..40.
    width = 53 * scale
    assert picture.shape == (40 * scale, 3 * width + 2 * PANEL_GAP_PX, 3)
    second, third = width + PANEL_GAP_PX, 2 * (width + PANEL_GAP_PX)
    # The near car's own corner, outside of the far car's region: tinted, but not part of the occlusion mask.
    tint = (0.45 * 128 + 0.55 * np.array(OCCLUDER_COLOURS[0])).astype(np.uint8)
    assert picture[5 * scale, second + 5 * scale].tolist() == tint.tolist()
    assert picture[5 * scale, third + 5 * scale].tolist() == [0, 0, 0]
    assert picture[15 * scale, third + 15 * scale].tolist() == [255, 255, 255]
    assert picture[25 * scale, third + 15 * scale].tolist() == [0, 0, 0]


def test_wrong_car_is_named() -> None:
    frames, detections = two_cars()
    with pytest.raises(InputError, match=r"object_number: expected 0\.\.2, got 3"):
        occlusion_picture(frames, detections, REGIONS, 3)
    with pytest.raises(InputError, match="a region with pixels for car 2"):
        occlusion_picture(frames, detections, REGIONS, 2)
