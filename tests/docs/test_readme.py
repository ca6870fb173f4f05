"""The README's Python runs as it stands, and its commands are the ones that CI runs."""

from __future__ import annotations

import re
from operator import attrgetter
from pathlib import Path

import pytest
import torch

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")


def test_the_python_example_runs_and_has_the_shapes_that_it_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}

    exec(compile(code, "README.md", "exec"), names)

    result = names["result"]
    assert result.T_cam_obj.shape == (6, 4, 4)
    assert result.code.shape == (6, 8)
    assert result.covariance_xyz_yaw.shape == (6, 4, 4)
    assert bool((torch.nan_to_num(result.quality.mask_iou_left) > 0.85).all())
    assert (tmp_path / "car0.ply").stat().st_size > 1000
    assert sum(bool(line) for line in code.splitlines()) == 10
    also = re.findall(r"^\| `([\w.]+)` \| \(([\d, ]+)\) \|", README, re.MULTILINE)
    assert len(also) >= 4
    for name, shape in also:
        assert attrgetter(name)(result).shape == tuple(int(size) for size in re.findall(r"\d+", shape)), name


@pytest.mark.parametrize("name", ["demo", "tests"])
def test_each_marked_command_is_one_shell_line(name: str) -> None:
    (command,) = re.findall(rf"<!-- command: {name} -->\n```bash\n(.*?)```", README, re.DOTALL)

    assert command.strip().count("\n") == 0
    assert command.startswith("python3 -m venv")


def test_every_relative_link_leads_to_a_file() -> None:
    links = re.findall(r"\]\((?!https?://)([^)#]+)", README)

    assert links
    for link in links:
        assert (Path(__file__).parents[2] / link).exists(), link
