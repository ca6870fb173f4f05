"""This script tries the package with other versions of the libraries that it needs, each in a new environment.

    python scripts/check_torch_versions.py torch==2.8.0 torch==2.14.1
    python scripts/check_torch_versions.py numpy==1.26.4,torch==2.13.0 --tests tests/io tests/scene

An argument is an environment: its pins, joined by commas. The wheel of this checkout, without the lower bounds of its
libraries, is installed with them; all others are the newest that pip takes. The demo's IoU are compared with those of
the environment that runs the script. Tests run in a copy of the checkout that has the installed package alone
(`--tests tests` runs all). The script prints a table, and its exit code is 1 where an environment is not made, the demo
differs or a test fails. PyTorch brings up to 7 GB of CUDA libraries, so there is one environment at a time.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import venv
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from command_line import run_command

from directshape_torch.errors import DirectShapeError, InputError

ROOT = Path(__file__).resolve().parents[1]
ROOMS = [f"tests/{room}" for room in ("geometry", "refiner", "shape", "solver", "state", "terms")]
_PIN = re.compile(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+_-]+")
_SAME_IOU = 0.0051  # half of the last digit that the demo prints, and its rounding


@dataclass(frozen=True)
class Row:
    """A row is what one environment gave; what did not come about is `-`."""

    pins: str
    demo: str = "-"
    tests: str = "-"
    failure: str = "-"

    def __str__(self) -> str:
        return f"| {self.pins} | {self.demo} | {self.tests} | {self.failure} |"


def run(args: argparse.Namespace) -> int:
    """Try each environment; return 1 where one of them is not as it should be.

    Raises:
        InputError: an environment is not a list of pins, or a test is not there.
    """
    for pin in [pin for pins in args.pins for pin in pins.split(",")]:
        if not _PIN.fullmatch(pin):
            raise InputError("an environment", "pins NAME==VERSION, joined by commas", repr(pin), "e.g. torch==2.8.0")
    for room in args.tests:
        if not (ROOT / room).exists():
            raise InputError("--tests", "files or folders of this checkout", repr(room))
    with TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        copy_checkout(checkout)
        drop_bounds(checkout / "pyproject.toml")
        _succeed([sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", folder, str(checkout)])
        (wheel,) = Path(folder).glob("*.whl")
        shutil.rmtree(checkout / "directshape_torch")
        expected = demo_ious(sys.executable, Path(folder), dict(os.environ))
        print("| versions | demo | tests passed, failed | first failure |\n|---|---|---|---|")
        rows = []
        for pins in args.pins:
            rows.append(tried(pins, wheel, checkout, args.tests, expected))
            print(rows[-1], flush=True)
    return int(any(row.demo != "same" or row.failure != "-" for row in rows))


def copy_checkout(target: Path) -> None:
    """Copy what git knows or would add, because a folder `build` of an older state would go into the wheel."""
    names = _succeed(["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"])
    for name in filter(None, names.split("\0")):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target / name, follow_symlinks=False)


def drop_bounds(pyproject: Path) -> None:
    """Remove lower bounds of libraries, because pip would not install the package with older ones."""
    pyproject.write_text(re.sub(r'"([\w-]+)>=[\d.]+"', r'"\1"', pyproject.read_text("utf-8")), "utf-8")


def tried(pins: str, wheel: Path, checkout: Path, tests: Sequence[str], expected: Sequence[float]) -> Row:
    """Make an environment, run demo and tests in it, and remove it."""
    shown = pins.replace("==", " ").replace(",", ", ")
    # The environment must not see packages of another one.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python, report = str(Path(folder) / "bin" / "python"), Path(folder) / "tests.xml"
        try:
            _succeed([python, "-m", "pip", "install", "--quiet", f"{wheel}[test]", *pins.split(",")], env=env)
            found = demo_ious(python, Path(folder), env)
        except CommandError as error:
            return Row(shown, failure=str(error))
        options = ["-q", "-p", "no:cacheprovider", f"--junitxml={report}"]
        command = [python, "-m", "pytest", *options, *tests]
        subprocess.run(command, cwd=checkout, env=env, capture_output=True, check=False)
        return Row(shown, compared(found, expected), *counted(report))


def demo_ious(python: str, folder: Path, env: dict[str, str]) -> list[float]:
    """The IoU of each car after the demo, and their mean."""
    command = [python, "-m", "directshape_torch", "demo", "--fresh", "--out", str(folder / "demo")]
    changes = (re.findall(r"-> +(\d+\.\d+)", line) for line in _succeed(command, cwd=folder, env=env).splitlines())
    return [float(each[-1]) for each in changes if each]


def compared(found: Sequence[float], expected: Sequence[float]) -> str:
    """The word "same", or how far the IoU of cars are apart."""
    if len(found) != len(expected):
        return f"{len(found)} lines instead of {len(expected)}"
    apart = max((abs(a - b) for a, b in zip(found, expected, strict=True)), default=0.0)
    return "same" if apart <= _SAME_IOU else f"IoU {apart:.2f} apart"


def counted(report: Path) -> tuple[str, str]:
    """Numbers of tests that passed and failed, and the first that failed, from pytest's report."""
    if not report.exists():
        return "-", "pytest did not run"
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    wrong = [(case, each) for case in cases for each in case if each.tag in ("failure", "error")]
    skipped = sum(each.tag == "skipped" for case in cases for each in case)
    failure = "-"
    if wrong:
        case, each = wrong[0]
        failure = f"{case.get('classname')}.{case.get('name')}: {_last_line(each.get('message') or '')}"
    return f"{len(cases) - len(wrong) - skipped}, {len(wrong)}", failure


class CommandError(DirectShapeError):
    """A `CommandError` says which command failed, with its last line."""


def _succeed(command: Sequence[str], **options: object) -> str:
    """What a command prints; `CommandError` is raised where it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)  # type: ignore[call-overload]
    if done.returncode:
        raise CommandError(f"{' '.join(command[:4])} .. failed: {_last_line(done.stderr)}")
    return str(done.stdout)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:160].replace("|", "/") if lines else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pins", nargs="+", metavar="ENVIRONMENT", help="pins of one environment, joined by commas")
    parser.add_argument("--tests", nargs="+", default=ROOMS, metavar="TESTS", help=f"default: {' '.join(ROOMS)}")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
