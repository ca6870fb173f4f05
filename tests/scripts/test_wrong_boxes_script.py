"""The table of wrong boxes says what became of them, and its changes are those that it names."""

from __future__ import annotations

import math

import pytest
import torch
import wrong_boxes as script
from helpers.bundled_frame import BOXES, DEMO, MASKS

from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose


def test_cars_turn_about_themselves_and_move_along_their_rays() -> None:
    poses = pose_from_kitti(torch.tensor([[3.0, 1.6, 4.0]]), torch.tensor([0.2]))
    turned, farther = script.turned(90.0)(poses), script.farther(5.0)(poses)
    assert torch.equal(turned[:, :3, 3], poses[:, :3, 3])
    assert rotation_y_from_pose(turned).tolist() == pytest.approx([0.2 + math.pi / 2])
    torch.testing.assert_close(farther[0, :3, 3], torch.tensor([6.0, 1.6, 8.0]))


def test_a_row_tells_how_many_cars_were_found(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(script, "WRONG", {"turned": script.turned(90.0)})
    data = ["--data", str(DEMO), "--detections", str(BOXES)]
    assert script.main([*data, "--masks", str(MASKS), "--search", "off", "rescue"]) == 0
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[:3] for row in rows[:2]] == [["turned", "off", "6"], ["turned", "rescue", "6"]]
    assert int(rows[0][5]) == 0
    assert int(rows[1][5]) >= 5
    # The demo has one frame, so its masks are laid on it twice.
    assert [row[0] for row in rows[-2:]] == ["their own image", "the next image"]
    assert rows[-1][1] == rows[-2][1]
    stand_out, _, count = rows[-1][1].split()
    assert int(stand_out) >= int(count) - 1
