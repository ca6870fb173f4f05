"""Every layout makes boxes of masks where there are no detections, and finds the right masks of the left ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bundled_frame import DEMO, MASKS, with_mirror_image, with_true_boxes
from helpers.bundled_frame import demo as demo_with_boxes
from helpers.layouts import write_odometry, write_raw, write_sequence

from directshape_torch.errors import InputError
from directshape_torch.io.frame_detections import detections_of_masks
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.io.stereo_dataset import LayoutName, LoadedFrame, open_dataset

FRAMES = ("000000", "000001")


@pytest.fixture(scope="module")
def demo() -> LoadedFrame:
    return open_dataset("kitti", DEMO, masks=MASKS).load("000000")


def masks_of_demo(loaded: LoadedFrame) -> list[InstanceMask]:
    dataset = open_dataset("kitti", DEMO, masks=MASKS)
    assert dataset.masks is not None
    height, width = loaded.frame.images_left.shape[2:]
    return dataset.masks.read("000000", (height, width))


def test_lines_and_detections_say_the_same(demo: LoadedFrame) -> None:
    assert demo.refined_rows == tuple(range(6))
    location = torch.tensor([line.location_ref for line in demo.input_objects]) + demo.frame.camera.t_cam_ref
    torch.testing.assert_close(location, demo.detections.T_cam_obj[:, :3, 3], rtol=0, atol=1e-4)
    hwl = torch.tensor([line.hwl for line in demo.input_objects])
    torch.testing.assert_close(hwl, demo.detections.dimensions_hwl, rtol=0, atol=1e-4)


def test_right_masks_belong_to_the_left_ones(demo: LoadedFrame) -> None:
    masks = masks_of_demo(demo)
    shuffled = sorted(masks, key=lambda mask: (mask.side, -mask.instance_id if mask.side == "right" else 0))
    found, _ = detections_of_masks(shuffled, demo.frame)
    assert found.detections.mask_right.dense().equal(demo.detections.mask_right.dense())
    assert demo.detections.mask_right.dense().equal(with_true_boxes().detections.mask_right.dense())


def test_left_masks_suffice_and_others_hide(demo: LoadedFrame) -> None:
    masks = [mask for mask in masks_of_demo(demo) if mask.side == "left"]
    others = [InstanceMask(m.side, m.instance_id, False, m.corner, m.probability) for m in masks[:2]]
    found, objects = detections_of_masks([*others, *masks[2:]], demo.frame)
    assert len(objects) == len(found.detections) == 4
    assert not found.detections.has_mask_right.any()
    assert found.detections.occluders is not None
    assert len(found.detections.occluders.frame_index) == 2


def test_rows_that_show_a_mirror_image_are_left_out_in_both_images() -> None:
    mask, frame = with_mirror_image(3)
    u0, v0, _, v1 = demo_with_boxes().detections.mask_right.boxes[3].tolist()
    right = demo_with_boxes().detections.mask_right.crop(3).numpy() > 0.5
    mirrored = np.pad(right, ((0, 6 * (v1 - v0) // 10), (0, 0)), mode="symmetric")
    left = InstanceMask.found("left", 1, True, mask[0].numpy())
    assert left is not None
    found, _ = detections_of_masks([left, InstanceMask("right", 1, True, (u0, v0), mirrored)], frame)
    end_left, end_right = (of.boxes[0, 3] for of in (found.detections.mask_left, found.detections.mask_right))
    assert v1 <= end_right == end_left < left.crop_box[3]


@pytest.mark.parametrize("layout", ["raw", "tracking", "odometry"])
def test_sequences_need_no_detections(layout: LayoutName, kitti: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    if layout == "raw":
        root = write_raw(kitti, root, FRAMES)
    elif layout == "tracking":
        write_sequence(kitti, root, FRAMES, single=True)
    else:
        write_odometry(kitti, root, FRAMES)
        root = root / "sequences" / "04"
    digits = 10 if layout == "raw" else 6
    names = [f"{number:0{digits}d}" for number in range(2)]
    for name in names:
        (tmp_path / "masks").mkdir(exist_ok=True)
        (tmp_path / "masks" / f"{name}.json").write_bytes((kitti / "masks" / "000000.json").read_bytes())
    dataset = open_dataset(layout, root, masks=tmp_path / "masks")
    assert dataset.frame_ids == tuple(names)
    loaded = dataset.load(names[1])
    assert len(loaded.detections) == len(loaded.input_objects) == 2
    assert "detections" not in dataset.input_files(names[1])
    tracked = open_dataset(layout, root, masks=tmp_path / "masks", tracks=True)
    assert tracked.load(names[0]).detections.track_id.tolist() == [-1, -1]


def test_frames_without_masks_are_not_chosen(kitti: Path, tmp_path: Path) -> None:
    assert open_dataset("kitti", kitti, masks=kitti / "masks").frame_ids == FRAMES
    (tmp_path / "000001.json").write_bytes((kitti / "masks" / "000001.json").read_bytes())
    assert open_dataset("kitti", kitti, masks=tmp_path).frame_ids == ("000001",)
    assert open_dataset("kitti", kitti, masks=tmp_path, frames=[0]).frame_ids == ("000000",)
    (tmp_path / "000001.json").unlink()
    with pytest.raises(InputError, match="masks: expected a left image with a file of masks in"):
        open_dataset("kitti", kitti, masks=tmp_path)


def test_a_plain_folder_needs_no_frames(kitti: Path, tmp_path: Path) -> None:
    for name, source in (("left", "image_2"), ("right", "image_3")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.png").write_bytes((kitti / "training" / source / "000000.png").read_bytes())
    rig = '{"schema_version": 1, "image_size_wh": [%d, %d], "K_left": %s, "baseline_m": 0.5}'
    height, width = open_dataset("kitti", kitti, kitti / "detections").load("000000").frame.sizes[0].tolist()
    K = [[105.0, 0, width / 2], [0, 105.0, height / 2], [0, 0, 1]]
    (tmp_path / "rig.json").write_text(rig % (width, height, K))
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "a.json").write_bytes((kitti / "masks" / "000000.json").read_bytes())
    dataset = open_dataset("folder", tmp_path, masks=tmp_path / "masks")
    assert dataset.frame_ids == ("a",)
    assert len(dataset.load("a").detections) == 2
    with pytest.raises(InputError, match="detections: expected a folder of detections for the layout 'folder'"):
        open_dataset("folder", tmp_path)
