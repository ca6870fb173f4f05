"""These tests check the program's commands, its one-line errors and its exit codes."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

import directshape_torch
from directshape_torch.cli import main as program
from directshape_torch.errors import DataFormatError


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        program.main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert {"refine", "demo", "build_prior", "calibrate_rig", "export"} < set(program.COMMANDS)
    for command in program.COMMANDS:
        assert re.search(rf"^ {{4}}{command.replace('_', '-')}\s", text, re.MULTILINE)


@pytest.mark.parametrize("arguments", [["refin"], ["refine"], ["compare", "--labels", "x"]])
def test_wrong_usage_is_exit_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        program.main(arguments)
    assert stop.value.code == 2
    assert "usage: directshape" in capsys.readouterr().err


def test_the_bare_program_shows_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main([]) == 2
    assert "check-data" in capsys.readouterr().err


def test_the_version_is_that_of_the_program(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        program.main(["--version"])
    assert capsys.readouterr().out.strip() == directshape_torch.__version__
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        directshape_torch.nothing  # noqa: B018


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            DataFormatError("calib/000001.txt", "expected 12 numbers,\n got 11", line_number=3),
            program.EXIT_WRONG_INPUT,
            "error: calib/000001.txt, line 3: expected 12 numbers, got 11",
        ),
        (BrokenPipeError("a worker is gone"), program.EXIT_WRONG_INPUT, "error: a worker is gone"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_is_one_line_and_an_exit_code(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, said: str
) -> None:
    def fail(_: object) -> int:
        raise error

    monkeypatch.setattr("directshape_torch.cli.demo.run", fail)
    assert program.main(["demo"]) == code
    shown = capsys.readouterr()
    assert (shown.out.strip(), shown.err) == ("", f"directshape: {said}\n")


def test_the_package_is_the_program_and_help_loads_only_what_it_needs() -> None:
    script = (
        "import runpy, sys, directshape_torch\nbefore, sys.argv = set(sys.modules), ['directshape', '--help']\n"
        "try: runpy.run_module('directshape_torch', run_name='__main__')\n"
        "except SystemExit: print(*sorted({m.split('.')[0] for m in set(sys.modules) - before}))"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert "calibrate-rig" in output
    loaded = set(output.splitlines()[-1].split())
    assert "directshape_torch" in loaded
    assert not {"trimesh", "skimage", "scipy", "matplotlib", "pycocotools", "rerun"} & loaded


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    """`directshape ... | head -1`: quiet, with the exit code that a shell gives to such an end."""
    print_much = "lambda _: [print('line', n) for n in range(100_000)] and 0"
    code = (
        f"from directshape_torch.cli import demo, main; demo.run = {print_much}; raise SystemExit(main.main(['demo']))"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "line 0\n"
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(60) == program.EXIT_OUTPUT_CLOSED
