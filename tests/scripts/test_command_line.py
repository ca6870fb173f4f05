"""Exit codes of the programs, and one line for input that cannot be used."""

from __future__ import annotations

import argparse

import pytest
from command_line import run_command

from directshape_torch.errors import InputError


@pytest.fixture
def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser()
    parser.add_argument("--code", type=int)
    return parser


@pytest.mark.parametrize("code", [0, 1, 3])
def test_the_code_of_the_run(parser: argparse.ArgumentParser, code: int) -> None:
    assert run_command(parser, lambda args: args.code, ["--code", str(code)]) == code


def test_a_run_without_a_code_is_a_success(parser: argparse.ArgumentParser) -> None:
    assert run_command(parser, lambda _: None, []) == 0


def test_wrong_input_is_one_line(parser: argparse.ArgumentParser, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(_: argparse.Namespace) -> None:
        raise InputError("--code", "a number", "none")

    assert run_command(parser, fail, []) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "error: --code: expected a number, got none\n")


def test_other_failures_keep_their_traceback(parser: argparse.ArgumentParser) -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(parser, lambda _: 1 // 0, [])
