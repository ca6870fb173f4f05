"""Object frames are found in a tracking sequence by their boxes."""

import os
from pathlib import Path

import pytest
from paper_tables.data_sets import link_drive

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.car_identity import CarIdentity


def _tracking_line(frame: int, track: int, x: float, z: float) -> str:
    return f"{frame} {track} Car 0 0 0.1 10 10 60 40 1.516012 1.628068 3.941835 {x} 1.900249 {z} -1.538772"


def test_frames_and_cars_are_found(tmp_path: Path):
    sequence, training = tmp_path / "0042", tmp_path / "training"
    sequence.mkdir()
    (training / "label_2").mkdir(parents=True)
    lines = [_tracking_line(0, 3, 1.004, 20.0), _tracking_line(1, 3, 1.304, 19.5), _tracking_line(1, 8, -4.0, 30.004)]
    lines.append("1 -1 DontCare -1 -1 -10 1 1 2 2 -1000 -1000 -1000 -10 -1 -1 -1")
    (sequence / "label_02.txt").write_text("\n".join(lines) + "\n")
    box = "Car 0 0 0.1 10 10 60 40 1.52 1.63 3.94"
    # Frame 1 in another order, with a car that is not tracked; and a frame of another drive.
    known = [f"{box} -4.00 1.90 30.00 -1.54", f"{box} 9.00 1.90 9.00 0", f"{box} 1.30 1.90 19.50 -1.54"]
    (training / "label_2" / "000123.txt").write_text("\n".join(known) + "\n")
    (training / "label_2" / "000124.txt").write_text(f"{box} 1.30 1.90 19.60 -1.54\n")
    assert link_drive(training, sequence) == {
        ("000123", 1): CarIdentity("0042/8", "0042"),
        ("000123", 3): CarIdentity("0042/3", "0042"),
    }


def test_a_damaged_file_is_named(tmp_path: Path):
    (tmp_path / "label_02.txt").write_text("Car 0 0\n")
    with pytest.raises(DataFormatError, match=r"label_02\.txt, line 1: does not start with a frame number"):
        link_drive(tmp_path, tmp_path)


@pytest.mark.skipif("DIRECTSHAPE_DATA" not in os.environ, reason="DIRECTSHAPE_DATA is not set: KITTI frames needed")
def test_far_drive():
    root = Path(os.environ["DIRECTSHAPE_DATA"]) / "kitti"
    identities = link_drive(root / "training", root / "tracking" / "0005")
    assert len({frame for frame, _ in identities}) == 15
    # The data's own table: object frame 000516 is tracking frame 11; its cars 0, 1, 3 (from 0) are tracks 0, 1, 31.
    assert [identities["000516", line].car for line in (1, 2, 4)] == ["0005/0", "0005/1", "0005/31"]
    assert not any(frame in ("000107", "007322", "000274") for frame, _ in identities)
