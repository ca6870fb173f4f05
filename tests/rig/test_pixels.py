"""Pixels of known depth recover a known field under noise and wrong matches, directly and by the command."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from directshape_torch.cli.main import make_parser
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.kitti_calibration import KittiCalibration
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.from_files import known_depth_from_lidar
from directshape_torch.rig.pixels import pixel_evidence
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.rig_file import load_rigs

SIZE = (400, 160)
FOCAL_PX, BASELINE_M = 300.0, 0.5
TRUE = torch.tensor([-0.3, 0.1, 0.2, -0.5, 0.05, 0.1, -0.2, 0.1, 0.1, -0.3], dtype=torch.float64)
TRUE_VERTICAL = torch.tensor([0.1, 0.2, 0, 0, 0, 0.05, 0, 0, 0, 0], dtype=torch.float64)


def camera() -> StereoCamera:
    P = torch.tensor([[FOCAL_PX, 0, 200, 0], [0, FOCAL_PX, 80, 0], [0, 0, 1, 0]], dtype=torch.float64)
    P_right = P.clone()
    P_right[0, 3] = -FOCAL_PX * BASELINE_M
    return StereoCamera.from_projections(P[None], P_right[None])


def observations(count: int, outliers: float, lower_half: bool = False) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    uv = torch.rand(count, 2, generator=generator).double() * torch.tensor([399.0, 159.0])
    if lower_half:
        uv[:, 1] = 80 + uv[:, 1] / 2
    bias = polynomial_basis(uv, SIZE) @ TRUE + 0.1 * torch.randn(count, generator=generator).double()
    wrong = torch.rand(count, generator=generator) < outliers
    vertical = polynomial_basis(uv, SIZE) @ TRUE_VERTICAL + 0.1 * torch.randn(count, generator=generator).double()
    return torch.cat([uv, torch.stack([torch.where(wrong, bias + 3.0, bias), vertical], dim=1)], dim=1)


def image_grid() -> Tensor:
    u, v = torch.meshgrid(torch.linspace(0, 399, 21), torch.linspace(0, 159, 11), indexing="xy")
    return torch.stack([u, v], dim=-1).double()


def fitted(seen: Tensor, num_frames: int = 4) -> RigEstimate:
    rig = RigEstimate(SIZE, camera().K_left[0], camera().K_right[0], camera().T_right_cam[0])
    rig.add_pixels("lidar", pixel_evidence(seen, SIZE, num_frames))
    return rig


def test_fit_recovers_the_field_under_a_fifth_of_wrong_matches_on_one_side() -> None:
    field = fitted(observations(4000, outliers=0.2)).field
    error = field.bias(image_grid()) - polynomial_basis(image_grid(), SIZE) @ TRUE
    assert float(error.abs().mean()) < 0.03
    rows = field.offsets(image_grid())[1] - polynomial_basis(image_grid(), SIZE) @ TRUE_VERTICAL
    assert float(rows.abs().mean()) < 0.03


def test_too_few_observations_are_refused() -> None:
    with pytest.raises(InputError, match="at least 50"):
        pixel_evidence(torch.zeros(49, 4).double(), SIZE)


def test_a_point_right_behind_a_nearer_one_and_those_outside_are_left_out(tmp_path: Path) -> None:
    in_view = [[10, 0, 0, 0], [40, 0.2, 0, 0], [20, 5, 1, 0]]
    beside = [[10, 50, 0, 0], [10, -50, 0, 0], [10, 0, 50, 0], [10, 0, -50, 0]]
    too_near_or_far = [[-10, 3, 2, 0], [0.5, 0.2, 0.05, 0], [500, 90, 20, 0]]
    np.array(in_view + beside + too_near_or_far, dtype="<f4").tofile(tmp_path / "scan.bin")
    P2 = np.array([[300.0, 0, 200, 0], [0, 300, 80, 0], [0, 0, 1, 0]])
    P3 = P2 - np.array([[0, 0, 0, 150.0], [0, 0, 0, 0], [0, 0, 0, 0]])
    # x forward, y left, z up becomes x right, y down, z forward.
    velo_to_cam = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    calibration = KittiCalibration(Path("calib.txt"), P2, P3, np.eye(3), velo_to_cam)
    known = known_depth_from_lidar(tmp_path / "scan.bin", calibration, Rig.of(camera(), SIZE))
    # (20, 5, 1): 300 * -5 / 20 + 200 = 125 and 300 * -1 / 20 + 80 = 65; the second point is 1.5 px beside the first.
    expected = torch.tensor([[200.0, 80.0, 10.0], [125.0, 65.0, 20.0]], dtype=torch.float64)
    torch.testing.assert_close(known, expected)


def write_frame(root: Path, frame_id: str, bias_px: float, focal_px: float = FOCAL_PX) -> None:
    """Write a frame of a smooth texture on an upright wall, with measured disparity = true + bias."""
    training = root / "training"
    u, v = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    true = 12.0

    def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 128 + 40 * np.sin(x / 2.9 + y / 7) + 35 * np.sin(x / 5.3 - y / 4.1) + 30 * np.cos(x / 11.7 + y / 3.3)

    for folder, shift in (("image_2", 0.0), ("image_3", true + bias_px)):
        grey = texture(u + shift, v).clip(0, 255).astype(np.uint8)
        write_png(training / folder / f"{frame_id}.png", np.repeat(grey[..., None], 3, axis=2))
    # Known at every ninth pixel, as ground truth is; each costs time.
    stored = np.zeros((SIZE[1], SIZE[0]), np.uint16)
    stored[::3, ::3] = 256 * true
    write_png(training / "disp_occ_0" / f"{frame_id}.png", stored)
    lines = [
        f"{name}: {focal_px} 0 200 {shift} 0 {focal_px} 80 0 0 0 1 0"
        for name, shift in (("P2", 0.0), ("P3", -focal_px * BASELINE_M))
    ]
    (training / "calib").mkdir(exist_ok=True)
    (training / "calib" / f"{frame_id}.txt").write_text("\n".join(lines) + "\n")


def calibrate(root: Path, *more: str) -> int:
    args = make_parser().parse_args(
        ["calibrate-rig", "--data", str(root), "--from", "disparity", "--out", str(root / "bias.json"), *more]
    )
    return int(args.run(args))


def test_command_finds_a_constant_bias_in_images_and_evidence_of_a_file_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_frame(tmp_path, "000001", bias_px=-0.6)
    assert calibrate(tmp_path) == 0
    (field,) = (each.field for each in load_rigs(tmp_path / "bias.json"))
    bias = field.bias(torch.tensor([[100.0, 40.0], [200.0, 80.0], [350.0, 120.0]], dtype=torch.float64))
    torch.testing.assert_close(bias, torch.full((3,), -0.6, dtype=torch.float64), atol=0.05, rtol=0)
    assert (tmp_path / "bias.png").is_file()
    assert "px in the middle, from disparity (1 frames)" in capsys.readouterr().out
    assert calibrate(tmp_path, "--rig", str(tmp_path / "bias.json")) == 0
    (rig,) = load_rigs(tmp_path / "bias.json")
    assert rig.pixels["disparity"].num_frames == 2


def test_command_reports_a_damaged_frame_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame_id in ("000001", "000002"):
        write_frame(tmp_path, frame_id, bias_px=-0.6)
    broken = tmp_path / "training" / "image_3" / "000002.png"
    broken.write_bytes(broken.read_bytes()[:1000])
    assert calibrate(tmp_path) == 0
    assert "000002 left out" in capsys.readouterr().err
    (rig,) = load_rigs(tmp_path / "bias.json")
    assert rig.pixels["disparity"].num_frames == 1


def test_each_of_two_rigs_has_its_estimate_and_unknown_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match="training"):
        calibrate(tmp_path)
    write_frame(tmp_path, "000001", bias_px=0.0)
    write_frame(tmp_path, "000002", bias_px=0.5, focal_px=310.0)
    assert calibrate(tmp_path) == 0
    offsets = [rig.in_the_middle()[0] for rig in load_rigs(tmp_path / "bias.json")]
    assert offsets == pytest.approx([0.0, 0.5], abs=0.05)
    with pytest.raises(InputError, match="such as 000001, got 9"):
        calibrate(tmp_path, "--frames", "000009")


@pytest.mark.long
@pytest.mark.skipif(
    "DIRECTSHAPE_DATA" not in os.environ, reason="DIRECTSHAPE_DATA, the folder of KITTI frames, is not set"
)
def test_real_frame_has_the_known_field() -> None:
    from directshape_torch.io.layouts import object_layout
    from directshape_torch.rig.from_files import add_truth, observe_frame, truth_files

    root = Path(os.environ["DIRECTSHAPE_DATA"]) / "kitti"
    rigs: list[RigEstimate] = []
    truth = truth_files(root, "disparity")["007322"]
    add_truth(rigs, "disparity", [observe_frame(object_layout(root, root).files("007322"), truth, "disparity")])
    field = rigs[0].field
    left, middle, right = field.bias(torch.tensor([[60.0, 180.0], [620.0, 180.0], [1180.0, 150.0]]).double()).tolist()
    assert -1.6 < left < -0.6
    assert -0.5 < middle < 0.0
    assert -2.0 < right < -0.9
