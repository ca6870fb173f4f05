"""The script drops bounds, compares the demo's figures, counts tests, and refuses what is no pin."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import check_torch_versions as script
import pytest

TWO_CARS = """print('''car  depth   centre [m]      yaw [deg]     BEV IoU
1    13.5 m   0.81 ->  0.11   2.9 ->  1.2   0.59 ->  0.89  converged
mean          0.81 ->  0.11   2.9 ->  1.2   0.59 ->  0.88''')"""


def test_the_iou_of_each_line_of_the_demo_are_found(tmp_path: Path) -> None:
    (tmp_path / "directshape_torch.py").write_text(TWO_CARS)
    assert script.demo_ious(sys.executable, tmp_path, {"PYTHONSAFEPATH": ""}) == [0.89, 0.88]


@pytest.mark.parametrize(
    ("found", "says"), [([0.89, 0.88], "same"), ([0.89, 0.85], "IoU 0.03 apart"), ([0.89], "1 lines instead of 2")]
)
def test_figures_are_compared(found: list[float], says: str) -> None:
    assert script.compared(found, [0.89, 0.88]) == says


def test_lower_bounds_are_dropped_and_nothing_else(tmp_path: Path) -> None:
    shutil.copy(Path(__file__).parents[2] / "pyproject.toml", tmp_path)
    before = tomllib.loads((tmp_path / "pyproject.toml").read_text("utf-8"))
    script.drop_bounds(tmp_path / "pyproject.toml")
    after = tomllib.loads((tmp_path / "pyproject.toml").read_text("utf-8"))
    extras = before["project"].pop("optional-dependencies"), after["project"].pop("optional-dependencies")
    bounded = [before["project"].pop("dependencies"), *extras[0].values()]
    found = [after["project"].pop("dependencies"), *extras[1].values()]
    assert found == [[name.partition(">=")[0] for name in names] for names in bounded]
    assert any(">=" in name for name in bounded[0])
    assert after["project"] == before["project"]


def test_tests_are_counted_and_the_first_failure_is_named(tmp_path: Path) -> None:
    (tmp_path / "test_three.py").write_text(
        "import pytest\ndef test_a(): assert 1 == 1\ndef test_b(): raise ValueError('a | b')\n"
        "@pytest.mark.skip\ndef test_c(): ...\n"
    )
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--junitxml=report.xml", "test_three.py"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert script.counted(tmp_path / "report.xml") == ("1, 1", "test_three.test_b: ValueError: a / b")
    assert script.counted(tmp_path / "none.xml") == ("-", "pytest did not run")


@pytest.mark.parametrize("arguments", [["torch>=2"], ["torch==2.8.0,numpy"], ["torch==2.8.0", "--tests", "nowhere"]])
def test_wrong_use(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert script.main(arguments) == 2
    assert "expected" in capsys.readouterr().err
