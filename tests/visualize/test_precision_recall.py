"""Pictures of precision over recall."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from directshape_torch.errors import InputError
from directshape_torch.visualize.precision_recall import RecallCurve, RecallPanel, write_recall_plot


def _panel(values: np.ndarray) -> RecallPanel:
    return RecallPanel("IoU > 0.7", "precision", (RecallCurve("easy", values),))


def test_equal_curves_give_equal_bytes_and_others_do_not(tmp_path: Path) -> None:
    for name, values in (("a", np.ones(41)), ("b", np.ones(41)), ("c", np.linspace(1, 0, 41))):
        write_recall_plot(tmp_path / name, [_panel(values)], "Car")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a").read_bytes() != (tmp_path / "c").read_bytes()


def test_every_panel_has_its_place(tmp_path: Path) -> None:
    for count in (1, 3):
        write_recall_plot(tmp_path / f"{count}.png", [_panel(np.ones(41))] * count, "Car")
    one, three = (cv2.imread(str(tmp_path / f"{count}.png")) for count in (1, 3))
    assert three.shape[1] == pytest.approx(3 * one.shape[1], abs=2)
    assert three.shape[0] == one.shape[0]


def test_no_panels(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="panels: expected at least one, got none"):
        write_recall_plot(tmp_path / "a.png", [], "Car")
    assert not (tmp_path / "a.png").exists()
