"""These tests check single checks with numbers whose answer is known."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from helpers.bundled_frame import DEMO, LABELS, MASKS
from helpers.layouts import write_folder
from numpy.typing import NDArray

from directshape_torch.check import check_dataset as module
from directshape_torch.check.check_dataset import check_dataset
from directshape_torch.check.check_images import PairMatches, check_calibration, check_frame, check_pair
from directshape_torch.check.check_places import check_distances
from directshape_torch.check.finding import CheckReport, Finding, by_severity
from directshape_torch.check.mistakes import MISTAKES, found, unreadable, words_of_files, words_of_tensors
from directshape_torch.check.read_frame import numbers_of
from directshape_torch.cli.main import main
from directshape_torch.errors import InputError
from directshape_torch.geometry.box_formats import BoxFormat
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.image_files import read_pair
from directshape_torch.io.kitti_calibration import KittiCalibration
from directshape_torch.io.stereo_dataset import LayoutName, open_dataset

SIZE_HW = (400, 1200)
KITTI_WORDS = words_of_files(Path("calib.txt"))
K = np.array([[700.0, 0, 600], [0, 700, 200], [0, 0, 1]])


def calibration(baseline_m: float = 0.5, right: np.ndarray = K, down_m: float = 0.0) -> KittiCalibration:
    t = np.array([[-baseline_m], [down_m], [0]])
    return KittiCalibration(Path("calib.txt"), np.hstack([K, np.zeros((3, 1))]), np.hstack([right, right @ t]))


def camera(found: KittiCalibration) -> StereoCamera:
    return StereoCamera.from_projections(torch.from_numpy(found.P2)[None], torch.from_numpy(found.P3)[None])


def matches(
    row_offset: float = 0.0, disparity: float = 20.0, across: float = 0.0, count: int = 300, scatter: float = 0.2
) -> PairMatches:
    random = np.random.default_rng(0)
    uv_left = random.uniform((100, 0), (1200, 400), (count, 2))
    rows = row_offset + across * (uv_left[:, 0] / 1200 - 0.5) + random.normal(0, scatter, count)
    depth_spread = random.uniform(0.5, 1.5, count)
    uv_right = uv_left + np.column_stack([-disparity * depth_spread, rows])
    return PairMatches(uv_left, uv_right, count)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        (matches(), []),
        (matches(row_offset=0.5), []),
        (matches(row_offset=1.0), [("not_rectified", "warning")]),
        (matches(row_offset=-2.0), [("not_rectified", "error")]),
        (matches(across=3.0), [("not_rectified", "error")]),
        (matches(scatter=2.0, count=3000), [("not_synchronous", "warning")]),
        (matches(disparity=-20.0), [("images_swapped", "error")]),
        (matches(count=10), [("few_matches", "note")]),
        (PairMatches(np.zeros((40, 2)), np.zeros((40, 2)), 200), [("different_scenes", "error")]),
        (PairMatches(np.ones((40, 2)), np.ones((40, 2)), 40), [("same_image", "error")]),
    ],
)
def test_pairs(pair: PairMatches, expected: list[tuple[str, str]]) -> None:
    found = check_pair(pair, None, SIZE_HW, "frame 1")
    assert [(finding.check, finding.severity) for finding in found] == expected


def test_a_turned_camera_is_told_from_one_that_is_tilted() -> None:
    (finding,) = check_pair(matches(across=3.0), None, SIZE_HW, "frame 1")
    found = re.findall(r"([-+][0-9.]+) px more from (left|top)", finding.measured)
    slopes = {edge: float(number) for number, edge in found}
    assert slopes == {"left": pytest.approx(3.0, abs=0.3), "top": pytest.approx(0.0, abs=0.3)}


def test_errors_come_first_and_files_say_their_own_cure() -> None:
    note, error = (Finding("a", severity, "", "", "", "") for severity in ("note", "error"))
    assert by_severity([note, error]) == (error, note)
    for text, cure in (("a.json: is empty; write it", "write it"), ("a.json: is empty", "check the path and the file")):
        finding = unreadable("mask_file", "frame 1", ValueError(text))
        assert (finding.measured, finding.cure) == ("a.json: is empty", cure)


def test_rows_may_differ_as_the_calibration_says() -> None:
    """A right camera 5 cm lower sees everything higher by disparity x 5 / 50; one whose cy is 10 px larger, lower."""
    pair = matches()
    lower = PairMatches(
        pair.uv_left, pair.uv_right + [[0, 1.0]] * (pair.uv_left - pair.uv_right)[:, :1] * -0.1, len(pair)
    )
    assert check_pair(lower, None, SIZE_HW, "")[0].check == "not_rectified"
    assert check_pair(lower, camera(calibration(down_m=-0.05)), SIZE_HW, "") == []
    other_centre = K + np.array([[0, 0, 0], [0, 0, 10], [0, 0, 0]])
    shifted = PairMatches(pair.uv_left, pair.uv_right + np.array([0, 10]), len(pair))
    assert check_pair(shifted, None, SIZE_HW, "")[0].check == "not_rectified"
    assert check_pair(shifted, camera(calibration(right=other_centre)), SIZE_HW, "") == []


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (calibration(), []),
        (calibration(-0.5), ["baseline_sign"]),
        (calibration(50.0), ["baseline_length"]),
        (calibration(right=np.diag([4.0, 4.0, 1.0])), ["focal_length"]),
        (calibration(right=K + np.array([[0, 0, 300], [0, 0, 0], [0, 0, 0]])), ["principal_point"]),
        (calibration(right=np.diag([1, 0.5, 1]) @ K), ["focal_length", "principal_point"]),
    ],
)
def test_calibrations(found: KittiCalibration, expected: list[str]) -> None:
    findings = check_calibration(*numbers_of(found), SIZE_HW, "frame 1", KITTI_WORDS)
    assert [finding.check for finding in findings] == expected
    assert all(finding.where == "frame 1" or "of calib.txt" in finding.where for finding in findings)


def test_distances_tell_the_baseline_from_the_boxes() -> None:
    def ratios(stereo: float, size: float) -> NDArray[np.float64]:
        return np.tile([20.0, stereo, size], (10, 1))

    assert check_distances(np.empty((0, 3))) == check_distances(ratios(1.1, 1.0)) == []
    assert check_distances(ratios(1.2, 1.0))[0].severity == "warning"
    (of_baseline,) = check_distances(ratios(1.5, 1.0))
    assert of_baseline.severity == "error"
    assert "the baseline is wrong: divide it by 1.50" in of_baseline.cure
    assert "against the boxes" in check_distances(ratios(0.6, 0.62))[0].cure
    assert "focal length" in check_distances(ratios(1.5, 0.7))[0].cure


def test_matches_alone_settle_a_doubt_about_intrinsics() -> None:
    left, right = (next((DEMO / "training" / folder).glob("000000.*")) for folder in ("image_2", "image_3"))
    pair = read_pair(left, right)
    height, width = pair[0].shape[:2]
    K = np.array([[0.6 * width, 0.0, 0.5 * width], [0.0, 0.6 * width, 0.5 * height], [0.0, 0.0, 1.0]])
    numbers = ({"left": K, "right": K + np.array([[0, 0, 0], [0, 0, 1], [0, 0, 0]])}, 0.5)
    for match_images, said in ((False, [("raw_intrinsics", "warning")]), (True, [])):
        of_frame, _, usable = check_frame(numbers, None, pair, (height, width), "frame a", KITTI_WORDS, match_images)
        assert [(one.check, one.severity) for one in of_frame] == said
        assert usable is pair


def test_a_damaged_frame_of_a_folder_is_one_finding_and_hides_no_other(kitti: Path, tmp_path: Path) -> None:
    write_folder(kitti, tmp_path, ("000000", "000001"))
    path = tmp_path / "frames" / "000001.json"
    path.write_text(path.read_text()[:300])
    (tmp_path / "right" / "000000.png").write_bytes(b"no image")
    report = check_dataset(open_dataset("folder", tmp_path))
    assert [(finding.check, finding.where) for finding in report.findings if finding.severity == "error"] == [
        ("right_image", "frame 000000"),
        ("detection_file", "frame 000001"),
    ]
    assert report.num_cars == 2


def test_a_rig_file_of_images_of_another_size_is_one_finding(kitti: Path, tmp_path: Path) -> None:
    write_folder(kitti, tmp_path, ("000000",))
    path = tmp_path / "rig.json"
    path.write_text(path.read_text().replace("[160, 120]", "[80, 60]"))
    (finding,) = check_dataset(open_dataset("folder", tmp_path)).findings
    assert (finding.check, finding.severity) == ("image_size", "error")
    assert finding.measured.endswith("rig.json: is of images of 80 x 60 pixels, they have 160 x 120")


FOCAL_RIGHT = np.diag([1.01, 1.01, 1.0]) @ K


def test_matches_may_differ_as_differing_focal_lengths_say() -> None:
    """A right lens that magnifies by a hundredth shows points farther from its centre."""
    pair, cameras = matches(), camera(calibration(right=FOCAL_RIGHT))
    magnified = PairMatches(pair.uv_left, (pair.uv_right - K[:2, 2]) * 1.01 + FOCAL_RIGHT[:2, 2], len(pair))
    assert check_pair(magnified, None, SIZE_HW, "")[0].check == "not_rectified"
    assert check_pair(magnified, camera(calibration()), SIZE_HW, "")[0].check == "not_rectified"
    assert check_pair(magnified, cameras, SIZE_HW, "") == []


@pytest.mark.parametrize(
    "raw",
    [
        K + np.array([[0, 0, 0], [0, 0, 6], [0, 0, 0]]),  # the row of the centre
        K + np.array([[0, 0, -25], [0, 0, 0], [0, 0, 0]]),  # its column: far points seem to be beyond infinity
        FOCAL_RIGHT,
    ],
)
def test_intrinsics_of_raw_images_have_one_name(raw: np.ndarray) -> None:
    """Rectified images with K of the raw cameras, as a camera_info has it beside P."""
    (finding,) = check_pair(matches(), camera(calibration(right=raw)), SIZE_HW, "frame 1")
    assert (finding.check, finding.severity) == ("raw_intrinsics", "error")
    assert "P[:, :3]" in finding.cure
    assert "-P_right[0, 3] / P_right[0, 0]" in finding.cure


def test_intrinsics_that_differ_are_said_without_matches_once(kitti: Path, tmp_path: Path) -> None:
    for right, severity in ((FOCAL_RIGHT, "warning"), (np.diag([1.2, 1.2, 1.0]) @ K, "error")):
        findings = check_calibration(*numbers_of(calibration(right=right)), None, "frame 1", KITTI_WORDS)
        assert [(each.check, each.severity) for each in findings] == [("raw_intrinsics", severity)]
    write_folder(kitti, tmp_path, ("000000", "000001"))
    path = tmp_path / "rig.json"
    rig = json.loads(path.read_text())
    right = [list(row) for row in rig["K_left"]]
    right[1][2] += 7.0
    path.write_text(json.dumps(rig | {"K_right": right}))
    report = check_dataset(open_dataset("folder", tmp_path))
    (finding,) = (each for each in report.findings if each.check == "raw_intrinsics")
    assert finding.where == "frame 000000 and 1 more"
    assert finding.places == ("frame 000000", "frame 000001")


@pytest.mark.parametrize(
    ("change", "check", "words"),
    [
        ({"baseline_m": -0.5, "t_right_cam_m": None}, "baseline_sign", "give baseline_m as a distance without sign"),
        ({"baseline_m": None, "t_right_cam_m": [0.5, 0, 0]}, "baseline_sign", "(-baseline, 0, 0)"),
        (
            {"baseline_m": 540.0, "t_right_cam_m": None},
            "baseline_length",
            "give baseline_m (or t_right_cam_m) in metres",
        ),
    ],
)
def test_a_plain_folder_is_spoken_of_by_its_own_keys(
    change: dict[str, object], check: str, words: str, kitti: Path, tmp_path: Path
) -> None:
    write_folder(kitti, tmp_path, ("000000",))
    path = tmp_path / "rig.json"
    rig = {key: value for key, value in (json.loads(path.read_text()) | change).items() if value is not None}
    path.write_text(json.dumps(rig))
    report = check_dataset(open_dataset("folder", tmp_path))
    assert any(each.check == check and words in each.cure for each in report.findings), report
    assert not any(word in str(report) for word in ("P2", "P3", "rotation_y "))


def test_every_kind_of_mistake_has_words_in_every_source() -> None:
    sources = [
        *map(words_of_tensors, get_args(BoxFormat)),
        words_of_files(Path("calib.txt"), ("P_rect_02", "P_rect_03")),
        words_of_files(Path("rig.json")),
    ]
    of_files = {"baseline_sign", "no_cars", "calibration_file", "detection_file"}
    for words in sources:
        # Tensors have positive baselines, or none are made; and cars, or nothing is looked at.
        assert set(words.says) in (set(KITTI_WORDS.says), set(KITTI_WORDS.says) - of_files)
        for check in (*words.says, *MISTAKES):
            finding = found(check, "here", "this", words=words, low=0, high=1, limit=0.5, share=0.5, layout="kitti")
            assert all((finding.expected, finding.cure))
    raw = found("baseline_sign", "here", "this", words=sources[-2])
    assert raw.cure.startswith("swap P_rect_02 and P_rect_03")
    assert "bottom_center_m" in found("box_origin", "here", "this", words=sources[-1]).cure


def test_report_in_words() -> None:
    first = Finding("images_swapped", "error", "frame 1", "m", "e", "c")
    other = Finding("images_swapped", "error", "frame 2, P3 of calib.txt", "m of it", "e", "c")
    report = CheckReport(by_severity((first, other)), 9, 2, 5)
    assert report.exit_code == 1
    assert [finding.places for finding in report.findings] == [("frame 1", "frame 2, P3 of calib.txt")]
    assert str(report).splitlines() == [
        "error: images_swapped (frame 1 and 1 more)",
        "  measured  m",
        "  expected  e",
        "  cure      c",
        "",
        "1 error, 0 warnings, 0 notes in 2 of 9 frames with 5 cars",
    ]


def command(kitti: Path, *extra: str) -> list[str]:
    masks = ["--masks", str(kitti / "masks")]
    return ["check-data", "--data", str(kitti), "--detections", str(kitti / "detections"), *masks, *extra]


def test_command(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty" / "training").mkdir(parents=True)
    code = main([*command(kitti), "--data", str(tmp_path / "empty"), "--json", str(tmp_path / "found.json")])
    assert code == 1
    out = capsys.readouterr().out
    # Each kind of file once, and not again for each frame.
    assert out.count("error: missing_files (2 of 2 frames)") == 3
    assert "3 errors, 0 warnings, 0 notes in 2 frames with 4 cars" in out
    content = json.loads((tmp_path / "found.json").read_text())
    assert content["schema_version"] == 1
    assert {"check", "severity", "where", "measured", "expected", "cure", "places"} == set(content["findings"][0])
    assert main([*command(kitti), "--data", str(tmp_path / "nowhere"), "--json", "-"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["check"] == "layout"
    (tmp_path / "scans").mkdir()
    assert main(command(kitti, "--lidar", str(tmp_path / "scans"))) == 1
    assert f"no lidar: {tmp_path / 'scans' / '000000.bin'}" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(InputError, match="max_frames: expected at least 1"):
        check_dataset(open_dataset("kitti", kitti, kitti / "detections"), 0)


@pytest.mark.parametrize(("bias_px", "expected"), [(0.0, []), (1.5, ["rig_offset"])])
def test_a_field_that_the_cars_contradict(bias_px: float, expected: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The bundled frame is exact, so a field of 1.5 px is what is wrong; it has six cars."""
    monkeypatch.setattr(module, "_FEWEST_CARS", 4)
    dataset = open_dataset("kitti", DEMO, LABELS, MASKS)
    frame = dataset.load("000000").frame
    height, width = frame.sizes[0].tolist()
    matrices = (frame.camera.K_left[0], frame.camera.K_right[0], frame.camera.T_right_cam[0])
    field = DisparityField.constant(bias_px, (width, height), *matrices)
    found = module.check_rig(replace(dataset, ground="file", disparity_fields=(field,)), ["000000"])
    assert [finding.check for finding in found] == expected
    for finding in found:
        assert "m at 30 m" in finding.measured
        assert "--rig auto" in finding.cure


DATA = os.environ.get("DIRECTSHAPE_DATA")


@pytest.mark.long
@pytest.mark.skipif(DATA is None, reason="DIRECTSHAPE_DATA is not set")
@pytest.mark.parametrize(
    ("layout", "root", "detections", "masks"),
    [
        ("kitti", "rendered", "rendered/detections/mono", "rendered/masks_degraded"),
        ("kitti", "kitti", "kitti/detections/noisy_stereo", "kitti/training/masks"),
        ("tracking", "kitti/tracking/0005", "kitti/tracking/0005/detections/pointrcnn", "kitti/tracking/0005"),
    ],
)
def test_intact_frames(layout: LayoutName, root: str, detections: str, masks: str) -> None:
    base = Path(str(DATA))
    report = check_dataset(open_dataset(layout, base / root, base / detections, base / masks), 2)
    assert report.findings == ()
    assert report.num_checked == 2
    assert report.num_cars > 4
