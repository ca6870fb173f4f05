"""A field is estimated from images of a textured wall that comes nearer, read from a folder as by the command."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from directshape_torch.cli.main import make_parser
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.rig.from_files import gaps, observe_motion, open_sequence
from directshape_torch.rig.motion import MotionConstraint
from directshape_torch.rig.rig_file import load_rigs

SIZE = (320, 160)
FOCAL_PX, BASELINE_M, BIAS_PX = 300.0, 0.5, -0.4
DEPTHS_M = (12.0, 11.0, 10.0)


def texture(x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey levels of a wall: waves of many directions, 10 to 40 px long in the image."""
    generator = np.random.default_rng(0)
    grey = np.full(x_m.shape, 128.0)
    for angle, wave_m, phase in zip(
        generator.uniform(0, np.pi, 24), generator.uniform(0.35, 1.4, 24), generator.uniform(0, 6, 24), strict=True
    ):
        grey += 12 * np.sin(2 * np.pi * (x_m * np.cos(angle) + y_m * np.sin(angle)) / wave_m + phase)
    return np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def write_sequence(root: Path) -> None:
    """Write a left camera that drives towards a wall, and a right one whose disparity is wrong by `BIAS_PX`."""
    u, v = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    for number, depth in enumerate(DEPTHS_M):
        y_m = (v - 80) * depth / FOCAL_PX
        left = texture((u - 160) * depth / FOCAL_PX, y_m)
        right = texture((u + BIAS_PX - 160) * depth / FOCAL_PX + BASELINE_M, y_m)
        for folder, image in (("image_02", left), ("image_03", right)):
            write_png(root / folder / f"{number:06d}.png", image)
    P = f"{FOCAL_PX} 0 160 {{}} 0 {FOCAL_PX} 80 0 0 0 1 0"
    (root / "calib.txt").write_text(f"P2: {P.format(0)}\nP3: {P.format(-FOCAL_PX * BASELINE_M)}\n")


def test_a_wall_is_followed_to_where_it_is(tmp_path: Path) -> None:
    """Three frames give steps 1, 2 and 1; the wall's pixels move away from the centre by the ratio of its depths."""
    write_sequence(tmp_path)
    constraints = observe_motion(open_sequence(tmp_path).values(), height_m=1.65)
    tracks = [c for c in constraints if isinstance(c, MotionConstraint) and c.rig.size_wh == SIZE]
    assert len(tracks) == len(constraints) == 3
    for track, ratio in zip(tracks, (12 / 11, 12 / 10, 11 / 10), strict=True):
        assert len(track.uv) > 100
        centre = torch.tensor([160.0, 80.0])
        error = track.uv_later - (centre + ratio * (track.uv - centre))
        assert float(error.norm(dim=1).median()) < 0.05
    true = FOCAL_PX * BASELINE_M / 12.0
    assert float((tracks[0].seen[:, 2] - true).median()) == pytest.approx(BIAS_PX, abs=0.05)


def calibrate(root: Path, out: Path, *more: str) -> int:
    arguments = ["calibrate-rig", "--data", str(root), "--from", "motion", "--out", str(out), *more]
    args = make_parser().parse_args(arguments)
    return int(args.run(args))


def test_command_refuses_what_is_no_sequence(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match="image_02"):
        calibrate(tmp_path, tmp_path / "bias.json")
    write_sequence(tmp_path)
    with pytest.raises(InputError, match=r"such as 000000, got 9"):
        calibrate(tmp_path, tmp_path / "bias.json", "--frames", "000000", "000009")
    with pytest.raises(InputError, match="at least two"):
        calibrate(tmp_path, tmp_path / "bias.json", "--frames", "000000")
    with pytest.raises(InputError, match="camera-height"):
        calibrate(tmp_path, tmp_path / "bias.json", "--camera-height", "-1")
    right = tmp_path / "image_03" / "000001.png"
    right.write_bytes(right.read_bytes()[:500])
    with pytest.raises(DataFormatError, match="000001"):
        calibrate(tmp_path, tmp_path / "bias.json")
    right.unlink()
    with pytest.raises(DataFormatError, match=r"image_03: has no image of 000001; add the right image"):
        calibrate(tmp_path, tmp_path / "bias.json")
    assert not (tmp_path / "bias.json").exists()


def test_calibration_and_sizes_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    small = np.zeros((SIZE[1], SIZE[0] - 8, 3), np.uint8)
    write_png(tmp_path / "image_03" / "000001.png", small)
    with pytest.raises(DataFormatError, match=r"image_03/000001\.png: has 312 x 160 pixels, the left image 320"):
        calibrate(tmp_path, tmp_path / "bias.json")
    write_png(tmp_path / "image_02" / "000001.png", small)
    with pytest.raises(
        DataFormatError, match=r"000001\.png: is 312 x 160, the frames before it 320 x 160; give frames of"
    ):
        calibrate(tmp_path, tmp_path / "bias.json")
    (tmp_path / "calib.txt").write_text("P2: 300 0 160 0 0 300 80 0 0 0 1 0\n")
    with pytest.raises(DataFormatError, match="has no line P3:; a stereo pair needs"):
        calibrate(tmp_path, tmp_path / "bias.json")
    (tmp_path / "calib.txt").unlink()
    with pytest.raises(DataFormatError, match=r"calib\.txt"):
        calibrate(tmp_path, tmp_path / "bias.json")


def test_frames_are_taken_in_time_and_gaps_are_named(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    for folder in ("image_02", "image_03"):
        for number, name in enumerate(("9", "10", "14")):
            (tmp_path / folder / f"{number:06d}.png").rename(tmp_path / folder / f"{name}.png")
    sequence = list(open_sequence(tmp_path))
    assert sequence == ["9", "10", "14"]
    assert gaps(sequence) == [("10", "14")]
    assert gaps(list(open_sequence(tmp_path, ["14", 10]))) == []


def test_frames_that_do_not_determine_the_field_are_refused(tmp_path: Path) -> None:
    """The points of a single wall have one depth, so any constant bias looks like another length of the way."""
    write_sequence(tmp_path)
    with pytest.raises(InputError, match="determine the field"):
        calibrate(tmp_path, tmp_path / "bias.json", "--camera-height", "0")
    for folder in ("image_02", "image_03"):
        for number in (1, 2):
            (tmp_path / folder / f"{number:06d}.png").write_bytes((tmp_path / folder / "000000.png").read_bytes())
    with pytest.raises(InputError, match="drives past still things"):
        calibrate(tmp_path, tmp_path / "bias.json")


@pytest.mark.long
@pytest.mark.skipif(
    "DIRECTSHAPE_DATA" not in os.environ, reason="DIRECTSHAPE_DATA, the folder of KITTI frames, is not set"
)
def test_three_real_frames_come_near_the_field_of_ground_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(os.environ["DIRECTSHAPE_DATA"]) / "kitti"
    out = tmp_path / "bias.json"
    assert calibrate(root / "tracking" / "0005", out, "--frames", *(f"{k:06d}" for k in range(3))) == 0
    printed = capsys.readouterr().out
    assert "from motion (3 frames)" in printed
    (field,) = (rig.field for rig in load_rigs(out))
    left, middle, right = field.bias(torch.tensor([[60.0, 180.0], [620.0, 180.0], [1180.0, 150.0]]).double()).tolist()
    assert -2.3 < left < -1.0
    assert -0.8 < middle < -0.2
    assert -2.3 < right < -1.0
