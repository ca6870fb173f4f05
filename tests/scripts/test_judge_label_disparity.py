"""A disagreement of label and image that is put into a scene comes out of the judgement, and nothing else does."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import judge_label_disparity as script
import numpy as np
import pytest
import torch
from label_disparity import judgement, measurement, report

from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.disparity_field import DisparityField

SIZE = (400, 160)
FOCAL_PX, BASELINE_M = 600.0, 0.5
# Of the one wall that both images show; the car's rear lies in it. Its disparity is no whole number of pixels.
REAR_M = 20.2
LENGTH_M = 4.0
# The measurement takes the car's surface to lie 10 cm within its box.
TRUE_CENTRE_M = REAR_M - 0.1 + LENGTH_M / 2


def disparity_px(depth_m: float) -> float:
    return FOCAL_PX * BASELINE_M / depth_m


def car_line(depth_m: float, length_m: float = LENGTH_M, x_m: float = 0.0) -> str:
    """A car seen from behind, its box in the image always the same."""
    box = f"{200 + 30 * x_m - 27:.1f} 80 {200 + 30 * x_m + 27:.1f} 130"
    return f"Car 0 0 0 {box} 1.5 1.8 {length_m} {x_m} 1.6 {depth_m} {-math.pi / 2}"


def write_frame(
    root: Path, label: str, refined: str, bias_px: float = 0.0, frame_id: str = "000003", noise_grey: float = 0.0
) -> None:
    training, after = root / "training", root / "after" / "data"
    for folder in (training / "calib", training / "label_2", after):
        folder.mkdir(parents=True, exist_ok=True)
    u, v = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    for folder_name, shift in (("image_2", 0.0), ("image_3", disparity_px(REAR_M) + bias_px)):
        w = u + shift
        grey = 128 + 35 * np.sin(w / 2.9 + v / 7) + 30 * np.sin(w / 5.3 - v / 4.1) + 25 * np.cos(w / 11.7 + v / 3.3)
        noise = np.random.default_rng([int(frame_id), round(shift)]).normal(0, noise_grey, grey.shape)
        image = np.repeat((grey + noise).clip(0, 255).round().astype(np.uint8)[..., None], 3, axis=2)
        write_png(training / folder_name / f"{frame_id}.png", image)
    P2, P3 = (f"{FOCAL_PX} 0 200 {t} 0 {FOCAL_PX} 80 0 0 0 1 0" for t in (0, -FOCAL_PX * BASELINE_M))
    (training / "calib" / f"{frame_id}.txt").write_text(f"P2: {P2}\nP3: {P3}\n")
    (training / "label_2" / f"{frame_id}.txt").write_text(label + "\n")
    (after / f"{frame_id}.txt").write_text("".join(f"{line} 0.9\n" for line in refined.splitlines()))


def field_file(root: Path, bias_px: float, focal_px: float = FOCAL_PX) -> Path:
    K = torch.tensor([[focal_px, 0, 200], [0, focal_px, 80], [0, 0, 1]], dtype=torch.float64)
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -BASELINE_M
    DisparityField.constant(bias_px, SIZE, K, K, T_right_cam).save(root / "bias.json")
    return root / "bias.json"


def run(root: Path, *options: str) -> list[dict[str, str]]:
    table = root / "cars.csv"
    arguments = ["--data", str(root), "--after", str(root / "after"), "--csv", str(table), *options]
    assert script.main(arguments) == 0
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("label_too_far_m", [-0.6, 0.0, 0.4])
def test_a_shifted_label_is_the_disagreement_and_the_error_of_a_perfect_refinement(
    tmp_path: Path, label_too_far_m: float
) -> None:
    write_frame(tmp_path, car_line(TRUE_CENTRE_M + label_too_far_m), car_line(TRUE_CENTRE_M))
    (car,) = run(tmp_path)
    # Label farther than the image says: the image is nearer, so its disparity is larger.
    known_px = disparity_px(REAR_M) - disparity_px(REAR_M + label_too_far_m)
    assert float(car["image_px"]) == pytest.approx(known_px, abs=0.04)
    assert float(car["centre_px"]) == pytest.approx(known_px, abs=1e-3)
    assert float(car["side_px"]) == pytest.approx(known_px, abs=1e-3)
    # Footprints of 4 m, one behind the other.
    assert float(car["bev_iou"]) == pytest.approx((4 - abs(label_too_far_m)) / (4 + abs(label_too_far_m)), abs=1e-4)
    assert float(car["bev_iou_moved"]) > 0.96
    assert int(car["num_patches"]) > 100


def test_the_stated_error_is_that_of_the_measurement(tmp_path: Path) -> None:
    for number in range(8):
        frame_id = f"{number:06d}"
        write_frame(tmp_path, car_line(TRUE_CENTRE_M), car_line(TRUE_CENTRE_M), frame_id=frame_id, noise_grey=3.0)
    cars = run(tmp_path)
    actual = np.std([float(car["image_px"]) for car in cars])
    stated = np.median([float(car["image_sigma_px"]) for car in cars])
    # Eight draws tell a standard deviation to a quarter of itself; noise in bilinear lookups also pulls all alike.
    assert 0.5 < stated / actual < 2


def test_a_wrong_refinement_of_an_exact_label_is_no_disagreement(tmp_path: Path) -> None:
    write_frame(tmp_path, car_line(TRUE_CENTRE_M), car_line(TRUE_CENTRE_M + 0.5))
    (car,) = run(tmp_path)
    assert float(car["image_px"]) == pytest.approx(0, abs=0.04)
    assert float(car["side_px"]) == pytest.approx(disparity_px(REAR_M + 0.5) - disparity_px(REAR_M), abs=1e-3)
    assert float(car["bev_iou_moved"]) == pytest.approx(float(car["bev_iou"]), abs=0.03)


def test_unseen_length_moves_the_centre_and_not_the_side(tmp_path: Path) -> None:
    write_frame(tmp_path, car_line(TRUE_CENTRE_M), car_line(TRUE_CENTRE_M - 0.35, LENGTH_M - 0.7))
    (car,) = run(tmp_path)
    assert float(car["side_px"]) == pytest.approx(0, abs=1e-3)
    assert float(car["centre_px"]) == pytest.approx(disparity_px(REAR_M - 0.35) - disparity_px(REAR_M), abs=1e-3)
    assert float(car["missing_length_m"]) == pytest.approx(0.7)
    assert float(car["bev_iou"]) == pytest.approx(3.3 / 4, abs=1e-3)
    assert float(car["bev_iou_full_length"]) == pytest.approx(1, abs=1e-3)


def test_the_field_of_the_rig_is_no_disagreement(tmp_path: Path) -> None:
    write_frame(tmp_path, car_line(TRUE_CENTRE_M), car_line(TRUE_CENTRE_M), bias_px=-0.4)
    (without,) = run(tmp_path)
    (with_field,) = run(tmp_path, "--stereo-bias", str(field_file(tmp_path, -0.4)))
    assert float(without["image_px"]) == pytest.approx(-0.4, abs=0.04)
    assert float(with_field["image_px"]) == pytest.approx(0, abs=0.04)


def test_a_field_of_another_rig_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_frame(tmp_path, car_line(TRUE_CENTRE_M), car_line(TRUE_CENTRE_M))
    arguments = ["--data", str(tmp_path), "--after", str(tmp_path / "after")]
    assert script.main([*arguments, "--stereo-bias", str(field_file(tmp_path, 0.0, focal_px=610.0))]) == 2
    assert "the rig's K_left" in capsys.readouterr().err


def test_what_a_nearer_car_hides_is_not_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nearer = car_line(TRUE_CENTRE_M - 3).replace("Car 0 0 0 173.0 80 227.0 130", "Van 0 0 0 150 60 250 150")
    write_frame(tmp_path, f"{car_line(TRUE_CENTRE_M)}\n{nearer}", car_line(TRUE_CENTRE_M))
    assert script.main(["--data", str(tmp_path), "--after", str(tmp_path / "after")]) == 1
    assert "no car could be measured (1 have too few patches)" in capsys.readouterr().err


def test_near_cars_are_left_out_on_request(tmp_path: Path) -> None:
    write_frame(tmp_path, car_line(TRUE_CENTRE_M), car_line(TRUE_CENTRE_M))
    assert script.main(["--data", str(tmp_path), "--after", str(tmp_path / "after"), "--min-depth", "30"]) == 1


def test_report_plot_and_placebo_of_several_cars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    for number, shift in enumerate((-0.6, 0.0, 0.6)):
        write_frame(tmp_path, car_line(TRUE_CENTRE_M + shift), car_line(TRUE_CENTRE_M), frame_id=f"00000{number}")
    tracks = tmp_path / "tracks.json"
    tracks.write_text(
        '{"schema_version": 1, "labels": {"000000": {"1": {"car": "7/4", "drive": "7"}},'
        ' "000001": {"1": {"car": "7/4", "drive": "7"}}}}'
    )
    cars = run(tmp_path, "--tracks", str(tracks), "--plot", str(tmp_path / "cars.png"))
    assert (tmp_path / "cars.png").read_bytes().startswith(b"\x89PNG")
    # Moved by the disagreement of either of the others, the car that was right gets worse.
    assert float(cars[1]["bev_iou_of_placebo"]) < 0.8 < float(cars[1]["bev_iou_moved"])
    printed = capsys.readouterr().out
    assert "3 cars measured; 0 more have too few patches" in printed
    groups = [line.split()[:2] for line in printed.splitlines() if line.startswith(("all ", "7 ", "7/4 "))]
    assert groups == [["all", "3"], ["7", "2"], ["7/4", "2"]] * 2
    # The errors are the disagreements themselves.
    (overall, *_) = [line.split() for line in printed.splitlines() if line.startswith("all ")]
    assert float(overall[7]) > 0.99
    assert float(overall[6]) < 0.04


def test_statistics_by_hand() -> None:
    assert measurement.spread(np.array([1.0, 2.0, 4.0, 10.0, 3.0])) == 1.0
    assert report.correlation(np.array([0.0, 1.0, 2.0]), np.array([1.0, -1.0, -3.0])) == pytest.approx(-1)
    assert math.isnan(report.correlation(np.array([0.0, 1.0]), np.array([0.0, 1.0])))


@pytest.mark.parametrize("heading", [-math.pi / 2, math.pi / 2])
def test_the_end_that_faces_the_camera_is_kept(heading: float) -> None:
    box = torch.tensor([1.0, 1.6, 30.0, 1.5, 1.7, 4.0, heading], dtype=torch.float64)
    expected = torch.tensor([1.0, 1.6, 30.5, 1.5, 1.7, 5.0, heading], dtype=torch.float64)
    torch.testing.assert_close(judgement.with_length(box, 5.0), expected)
