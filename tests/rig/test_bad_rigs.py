"""With any evidence, or none, the field stays bounded and its standard deviation honest."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.rig_rows import FIELD, SIZE_WH, estimate, rows_of_cars
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.rig.rig_file import load_rigs, save_rigs

# Far more than any rig is off by, and less than ruins a search.
TAME_PX = 3.5


def changed(rows: Tensor, column: int, change: Callable[[Tensor], Tensor]) -> Tensor:
    rows = rows.clone()
    rows[:, column] = change(rows[:, column])
    return rows


def alternately(by: float) -> Callable[[Tensor], Tensor]:
    return lambda x: x + by * (-1.0) ** torch.arange(len(x))


RIGHT = rows_of_cars(40, 0)
EVIDENCE = {
    "none": (RIGHT[:0], 0.3),
    "three detections": (RIGHT[:3], 0.15),
    "three of them wrong by 10 px": (changed(RIGHT[:3], 3, lambda x: x + 10), 0.25),
    "contradicting by 20 px": (changed(RIGHT, 3, alternately(20.0)), 0.2),
    "half of them wrong by 5 px": (changed(RIGHT, 3, lambda x: x + 5 * (torch.arange(len(x)) % 2)), 0.2),
    "all on the left": (rows_of_cars(40, 1, u_range=(20, 300)), 0.1),
    "all at one pixel": (changed(changed(RIGHT, 0, lambda x: 0 * x + 600), 1, lambda x: 0 * x + 190), 0.1),
    "the same detection forty times": (RIGHT[:1].repeat(40, 1), 0.2),
    "a detector without skill": (rows_of_cars(40, 3, noise=0.4), 0.2),
    "a detector 30 % too near": (rows_of_cars(40, 4, bias=-0.3), 0.1),
    "boxes of other images": (changed(RIGHT, 3, lambda x: x[torch.arange(len(x)).flip(0)] * 9), 0.2),
    "offsets that run away to the edges": (changed(RIGHT, 3, lambda x: x + (RIGHT[:, 0] - 600) / 40), 0.1),
}


@pytest.mark.parametrize(("rows", "least_sigma"), EVIDENCE.values(), ids=EVIDENCE)
def test_no_evidence_makes_a_wild_field(rows: Tensor, least_sigma: float) -> None:
    rig = estimate(rows)
    u, v = torch.meshgrid(torch.linspace(0, 1241, 25), torch.linspace(0, 374, 9), indexing="xy")
    mean, sigma = rig.offset_at(torch.stack([u, v], dim=-1).double())
    assert bool((mean.isfinite() & sigma.isfinite()).all())
    assert float(mean.abs().max()) < TAME_PX
    assert float(sigma.max()) > least_sigma
    assert str(rig).startswith("rig: ")


def test_where_no_car_was_the_estimate_is_not_sure() -> None:
    rig = estimate(rows_of_cars(60, 5, u_range=(20, 300)))
    seen, unseen = torch.tensor([[160.0, 190], [1150, 190]], dtype=torch.float64)
    assert float(rig.offset_at(unseen)[1]) > 1.5 * float(rig.offset_at(seen)[1])
    true = float(polynomial_basis(unseen, SIZE_WH) @ FIELD)
    assert abs(float(rig.offset_at(unseen)[0]) - true) < 2.5 * float(rig.offset_at(unseen)[1])


def entry(content: dict[str, Any]) -> dict[str, Any]:
    first: dict[str, Any] = content["rigs"][0]
    return first


BROKEN: dict[str, Callable[[dict[str, Any]], object]] = {
    "no schema": lambda c: c.pop("schema"),
    "a later version": lambda c: c.update(schema_version=2),
    "no rigs": lambda c: c.pop("rigs"),
    "rows too short": lambda c: entry(c).update(rows=[[1.0, 2.0]]),
    "rows of words": lambda c: entry(c).update(rows=[["a"] * 8]),
    "not finite": lambda c: entry(c)["rows"][0].__setitem__(0, None),
    "no camera": lambda c: entry(c).pop("K_left"),
    "no size": lambda c: entry(c).update(size_wh=[1242]),
}


@pytest.mark.parametrize("damage", BROKEN.values(), ids=BROKEN)
def test_a_damaged_file_is_named(tmp_path: Path, damage: Callable[[dict[str, Any]], object]) -> None:
    path = tmp_path / "rig.json"
    save_rigs(path, [estimate(rows_of_cars(5, 6))])
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(DataFormatError, match=r"rig\.json.*calibrate-rig") as raised:
        load_rigs(path)
    assert "another" not in str(raised.value), "what is wrong, not what it was taken for"


@pytest.mark.parametrize("text", ["", "[]", "{"])
def test_what_is_no_file_of_rigs_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(text)
    with pytest.raises(DataFormatError, match="calibrate-rig"):
        load_rigs(path)
