"""Every form of mask file gives the same instances, and damaged files are named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.instance_masks import decode_segmentation
from directshape_torch.io.mask_files import CocoFileMasks, FrameJsonMasks, InstancePngMasks, mask_source

SIZE_HW = (6, 9)
# Rows 1..3 of columns 4..5: off-diagonal in every sense, so a transposed mask shows.
MASK = np.zeros(SIZE_HW, bool)
MASK[1:4, 4:6] = True
# Column-major: 4 columns of 6 and one row are off (25), 3 on, 3 off, 3 on, and the rest of 54.
RUNS = [25, 3, 3, 3, 20]


def encoded(mask: NDArray[np.bool_]) -> str:
    import pycocotools.mask

    counts: bytes = pycocotools.mask.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"]
    return counts.decode("ascii")


def entry(**changes: Any) -> dict[str, Any]:
    return {"category_id": 3, "segmentation": {"size": list(SIZE_HW), "counts": RUNS}, **changes}


def write_json(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    "segmentation",
    [
        {"size": list(SIZE_HW), "counts": RUNS},
        {"size": list(SIZE_HW), "counts": encoded(MASK)},
        {"size": list(SIZE_HW), "counts": encoded(MASK).encode()},
        {"size": list(SIZE_HW), "counts": str(encoded(MASK).encode())},
        {"size": list(SIZE_HW), "counts": [float(run) for run in RUNS]},
        [[], [1, 1, 2, 2], [4, 1, 6, 1, 6, 4, 4, 4], [3, 3, 5, 5, 7]],
        [[4, 1, 6, 1, 6, 4, 4, 4]],
    ],
    ids=["list", "text", "bytes", "printed bytes", "whole floats", "polygons with and without area", "polygon"],
)
def test_segmentation_forms(segmentation: Any) -> None:
    np.testing.assert_array_equal(decode_segmentation(Path("a.json"), "entry 0", segmentation, SIZE_HW), MASK)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40), st.floats(0, 1))
def test_compressed_masks_of_any_content_pass_the_check(seed: int, height: int, width: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < share
    segmentation = {"size": [height, width], "counts": encoded(mask)}
    np.testing.assert_array_equal(decode_segmentation(Path("a.json"), "entry 0", segmentation, (height, width)), mask)


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        (7, "entry 7: 'segmentation' is neither RLE nor a list of polygons"),
        ([["a", "b"]], "neither RLE nor a list"),
        ({"size": [6, 9], "counts": [25, 3]}, "entry 7: run lengths cover 28 pixels, expected 6 x 9 = 54"),
        ({"size": [6, 9], "counts": encoded(MASK)[:-2]}, r"entry 7: run lengths cover \d+ pixels"),
        ({"size": [6, 9], "counts": "~~"}, "entry 7: bad run lengths .*'~' is not part"),
        ({"size": [6, 9], "counts": "o"}, "ends inside a number"),
    ],
)
def test_bad_segmentations(segmentation: Any, message: str) -> None:
    with pytest.raises(DataFormatError, match=rf"a\.json: .*{message}" if "entry" not in message else message):
        decode_segmentation(Path("a.json"), "entry 7", segmentation, SIZE_HW)


@pytest.mark.parametrize("folder", ["", "data"])
def test_frame_json(tmp_path: Path, folder: str) -> None:
    entries = [
        entry(image="left", instance_id=7, bbox=[3, 1, 4, 3], score=0.25),
        entry(image="right", category_id=1, score=None),
    ]
    write_json(tmp_path / folder / "000004.json", entries)
    left, right = mask_source(tmp_path).read("000004", SIZE_HW)
    assert (left.side, left.instance_id, left.is_car) == ("left", 7, True)
    # The pixels count, columns 4..5, whatever the file's box says.
    assert left.mask_box == (4, 1, 5, 3)
    assert (left.score, right.score) == (0.25, 1.0)
    assert (right.side, right.is_car, right.mask_box) == ("right", False, (4, 1, 5, 3))
    np.testing.assert_array_equal(right.whole(SIZE_HW), MASK)


def test_soft_probability_replaces_the_binary_mask(tmp_path: Path) -> None:
    soft = np.zeros(SIZE_HW, np.uint8)
    soft[2, 3:6] = [51, 204, 255]
    write_png(tmp_path / "soft" / "a.png", soft)
    write_json(tmp_path / "000000.json", [entry(image="left", soft_probability="soft/a.png")])
    source = FrameJsonMasks(tmp_path)
    (mask,) = source.read("000000", SIZE_HW)
    assert mask.probability.dtype == np.float32
    assert mask.crop_box == (3, 2, 6, 3)
    np.testing.assert_allclose(mask.probability[0], [0.2, 0.8, 1.0])
    assert mask.mask_box == (4, 2, 5, 2)
    assert source.files("000000") == (tmp_path / "000000.json", tmp_path / "soft" / "a.png")


@pytest.mark.parametrize(
    "nothing", [{"size": [6, 9], "counts": [54]}, [], [[]], None, [[1, 1, 3, 3]], [[1, 1, 3, 3, 5]], [[], [2, 2]]]
)
def test_an_empty_mask_is_no_instance_and_harms_no_other(tmp_path: Path, nothing: Any) -> None:
    write_json(tmp_path / "000000.json", [entry(image="left", segmentation=nothing), entry(image="left")])
    (mask,) = FrameJsonMasks(tmp_path).read("000000", SIZE_HW)
    assert mask.mask_box == (4, 1, 5, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"000000\.json: cannot be read"),
        ("[{", r"000000\.json: is not valid JSON"),
        ({}, r"000000\.json: is not a list of COCO results"),
        ([entry(image="middle")], "entry 0: 'image' is 'middle', expected 'left' or 'right'"),
        ([{"image": "left", "segmentation": {"size": [6, 9], "counts": RUNS}}], "entry 0: bad or missing field .*cat"),
        (
            [entry(image="left", segmentation=encoded(MASK))],
            r"000000\.json: entry 0: 'segmentation' is neither RLE nor",
        ),
        ([entry(image="left", score="high")], "entry 0: bad or missing field"),
        ([{"image": "left", "category_id": 3}], "entry 0 has no 'segmentation'"),
        (
            [entry(image="left", segmentation={"size": [9, 6], "counts": RUNS})],
            r"000000\.json: entry 0: the mask has 6 x 9 pixels \(width x height\), its image 9 x 6",
        ),
    ],
)
def test_bad_frame_json(tmp_path: Path, content: Any, message: str) -> None:
    if isinstance(content, str):
        (tmp_path / "000000.json").write_text(content)
    elif content is not None:
        write_json(tmp_path / "000000.json", content)
    with pytest.raises(DataFormatError, match=message):
        FrameJsonMasks(tmp_path).read("000000", SIZE_HW)


def test_masks_of_another_size(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.zeros((3, 4), np.uint8))
    write_json(tmp_path / "000000.json", [entry(image="left", soft_probability="a.png")])
    with pytest.raises(DataFormatError, match=r"a\.png: the soft mask has 4 x 3 pixels .* its image 9 x 6"):
        FrameJsonMasks(tmp_path).read("000000", SIZE_HW)
    write_png(tmp_path / "instance_2" / "000000.png", np.zeros((3, 4), np.uint16))
    with pytest.raises(DataFormatError, match=r"000000\.png: the instance image has 4 x 3 pixels .*its image 9 x 6"):
        InstancePngMasks(tmp_path).read("000000", SIZE_HW)
    with pytest.raises(DataFormatError, match="nowhere: is not a folder of masks"):
        mask_source(tmp_path / "nowhere")


@pytest.mark.parametrize(("car", "other", "nothing"), [(1003, 2001, 10000), (26003, 24000, 7)])
def test_instance_png_of_mots_and_cityscapes(tmp_path: Path, car: int, other: int, nothing: int) -> None:
    ids = np.zeros(SIZE_HW, np.uint16)
    ids[MASK] = car
    ids[5, :2] = other
    ids[0, 7:] = nothing
    write_png(tmp_path / "instance_2" / "000000.png", ids)
    write_png(tmp_path / "instance_3" / "000000.png", np.zeros(SIZE_HW, np.uint16))
    source = mask_source(tmp_path)
    assert isinstance(source, InstancePngMasks)
    found = {mask.instance_id: mask for mask in source.read("000000", SIZE_HW)}
    assert set(found) == {car, other}
    assert found[car].is_car
    assert not found[other].is_car
    assert found[car].mask_box == (4, 1, 5, 3)
    np.testing.assert_array_equal(found[car].whole(SIZE_HW), MASK)


def test_instance_png_of_kittis_semantic_benchmark(tmp_path: Path) -> None:
    """Road 7, pedestrian 24, car 26, all times 256; the road and what is no single instance are none."""
    ids = np.full(SIZE_HW, 7 * 256, np.uint16)
    ids[MASK] = 26 * 256 + 3
    ids[5, :2], ids[0, 7:] = 24 * 256 + 1, 26 * 256
    write_png(tmp_path / "instance_2" / "000000.png", ids)
    found = {mask.instance_id: mask for mask in mask_source(tmp_path).read("000000", SIZE_HW)}
    assert {number: mask.is_car for number, mask in found.items()} == {26 * 256 + 3: True, 24 * 256 + 1: False}
    np.testing.assert_array_equal(found[26 * 256 + 3].whole(SIZE_HW), MASK)


@pytest.mark.parametrize(
    ("numbers", "cars"), [((7 * 256, 8 * 256, 11 * 256), 0), ((7 * 256, 0), 0), ((0, 1024), 1), ((1256, 2048), 1)]
)
def test_a_street_without_instances_shows_no_car(tmp_path: Path, numbers: tuple[int, ...], cars: int) -> None:
    """Roads, 7 * 256, are no cars of class 1; cars whose numbers happen to be multiples of 256 are."""
    ids = np.full(SIZE_HW, numbers[0], np.uint16)
    for row, number in enumerate(numbers):
        ids[row] = number
    write_png(tmp_path / "instance_2" / "000000.png", ids)
    assert sum(mask.is_car for mask in mask_source(tmp_path).read("000000", SIZE_HW)) == cars


def test_instance_png_of_8_bits_is_refused_and_an_empty_one_is_not(tmp_path: Path) -> None:
    write_png(tmp_path / "instance_2" / "000000.png", np.where(MASK, 3, 0).astype(np.uint8))
    with pytest.raises(DataFormatError, match=r"has 8 bits and numbers up to 3, where class \* 1000 .*; write 16 bits"):
        mask_source(tmp_path).read("000000", SIZE_HW)
    write_png(tmp_path / "instance_2" / "000001.png", np.zeros(SIZE_HW, np.uint8))
    assert mask_source(tmp_path).read("000001", SIZE_HW) == []


def test_instance_png_of_the_left_images_alone(tmp_path: Path) -> None:
    write_png(tmp_path / "instance_2" / "000000.png", np.full(SIZE_HW, 1001, np.uint16))
    source = mask_source(tmp_path)
    assert [mask.side for mask in source.read("000000", SIZE_HW)] == ["left"]
    assert source.files("000000") == (tmp_path / "instance_2" / "000000.png",)
    with pytest.raises(DataFormatError, match=r"000000\.png: is an instance PNG, .* call their folder instance_2 "):
        mask_source(tmp_path / "instance_2").read("000000", SIZE_HW)


@pytest.mark.parametrize("number", [0.5, True, "x", None, [1]])
def test_an_image_id_that_is_no_number_of_a_frame_is_named(tmp_path: Path, number: Any) -> None:
    path = write_json(tmp_path / "l.json", [entry(image_id=number)])
    with pytest.raises(DataFormatError, match=r"l\.json: entry 0: 'image_id' is .*, expected the frame's number"):
        CocoFileMasks(path, None).read("000001", SIZE_HW)


def test_plain_coco_files_of_a_whole_data_set(tmp_path: Path) -> None:
    left = write_json(tmp_path / "l.json", [entry(image_id=8), entry(image_id=107), entry(image_id="8")])
    right = write_json(tmp_path / "r.json", [entry(image_id=107)])
    source = CocoFileMasks(left, right)
    assert [(m.side, m.instance_id) for m in source.read("000107", SIZE_HW)] == [("left", 1), ("right", 0)]
    assert [m.instance_id for m in source.read("000008", SIZE_HW)] == [0, 2]
    assert source.read("000009", SIZE_HW) == []
    assert [m.side for m in CocoFileMasks(None, right).read("000107", SIZE_HW)] == ["right"]


def test_plain_coco_files_that_do_not_fit(tmp_path: Path) -> None:
    source = CocoFileMasks(write_json(tmp_path / "k.json", []), None)
    with pytest.raises(InputError, match=r"frame_id: expected a number.*'first'"):
        source.read("first", SIZE_HW)
    with pytest.raises(InputError, match="at least one COCO result file"):
        CocoFileMasks(None, None)
