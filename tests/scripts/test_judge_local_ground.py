"""Heights over the plane are found round a car's foot; the table says how far truth is from plane and measurement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import judge_local_ground as script
import pytest
import torch

import directshape_torch
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.stereo_dataset import LoadedFrame

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"
DETECTIONS, MASKS = DEMO / "detections" / "noisy_stereo", DEMO / "training" / "masks"


@pytest.fixture(scope="module")
def demo() -> LoadedFrame:
    return KittiStereoDataset(DEMO, DETECTIONS, MASKS).load("000000")


def test_a_plane_that_is_15_cm_too_low_is_seen_round_near_cars(demo: LoadedFrame) -> None:
    """The demo's road is its plane; with the plane moved down, truth and measurement both say 15 cm."""
    ground = replace(demo.frame.ground, offset=demo.frame.ground.offset + 0.15)
    lowered = replace(demo, frame=replace(demo.frame, ground=ground))
    cars = script.judge_frame(lowered, script.counted_labels(lowered))
    near = [car for car in cars if car.depth_m < 15]
    assert len(near) >= 2
    for car in near:
        assert car.truth_m == pytest.approx(0.15, abs=0.03)
        assert car.local_m == pytest.approx(0.15, abs=0.03)
        assert 0 < car.shrunk_m <= car.local_m


def test_command_prints_the_table_and_what_heights_are_worth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def one_overlap(*_: object) -> list[tuple[float, ...]]:
        return [(0.5, 0.4, 0.6, 0.5, 0.7, 0.6)]

    monkeypatch.setattr(script, "refined_overlaps", one_overlap)
    arguments = ["--data", str(DEMO), "--detections", str(DETECTIONS), "--masks", str(MASKS)]
    assert script.main([*arguments, "--refine", "--csv", str(tmp_path / "cars.csv")]) == 0
    printed = capsys.readouterr().out
    assert "RMS of truth minus" in printed
    assert "true height                      0.700" in printed
    assert (tmp_path / "cars.csv").read_text().startswith("frame_id,detection,label_line,depth_m")


def test_boxes_overlap_with_themselves(demo: LoadedFrame) -> None:
    label = (demo.labels or [])[0]
    boxes = script.KittiBoxes(
        torch.tensor([label.hwl]), torch.tensor([label.location_ref]), torch.tensor([label.rotation_y]), torch.zeros(1)
    )
    assert script._overlap(boxes, 0, script._box(label)) == pytest.approx((1.0, 1.0), abs=1e-4)
