"""Runs mutants, each in a process of its own over a private copy of the tree; the checkout is never edited.

Processes are forked from a server that has PyTorch and pytest loaded already: a mutant costs its tests, not imports.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal

from jacobian_mutants.mutants import Mutant

Verdict = Literal["caught", "survived", "timed out"]
COPIED = ("directshape_torch", "tests", "pyproject.toml")
# A mutant may loop for ever, and one that does is found; the slowest named tests take 15 s on a busy machine.
TIMEOUT_S = 180.0


@dataclass(frozen=True)
class Outcome:
    """What the named tests said of a mutant."""

    mutant: Mutant
    target: str
    verdict: Verdict
    caught_by: str  # path::test, or empty
    error: str  # first line of what the test reported: a wrong number, or a crash


class TestsFailUnmutatedError(Exception):
    """The tests named for a target fail, or run against another tree, without any mutation."""


class MutationRunner:
    """Applies mutants to private copies of a tree and runs the tests named for them.

    Args:
        root: the tree; `copied` below it is what the tests need.
        processes: how many mutants run at once, each in a copy of its own.
        copied: files and folders of the tree.
    """

    def __init__(self, root: Path, processes: int = 2, copied: Sequence[str] = COPIED) -> None:
        self.root, self.processes, self.copied = root, processes, copied
        # Before the server of processes starts: its children inherit these.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["torch", "pytest", "numpy"])

    def run(
        self,
        mutants: Sequence[tuple[str, Mutant]],
        tests_of: dict[str, tuple[str, ...]],
        finished: Callable[[Outcome], None],
    ) -> list[Outcome]:
        """Outcomes in the order of `mutants` (target, mutant), after a check that the tests pass unmutated.

        Raises:
            TestsFailUnmutatedError: the tests of a target fail without a mutation.
        """
        with self._copies() as copies, ThreadPoolExecutor(self.processes) as pool:
            for target in dict.fromkeys(target for target, _ in mutants):
                self._check_unmutated(target, tests_of[target], copies)
            futures = {
                pool.submit(self._outcome, target, mutant, tests_of[target], copies): i
                for i, (target, mutant) in enumerate(mutants)
            }
            outcomes: dict[int, Outcome] = {}
            for future in as_completed(futures):
                outcomes[futures[future]] = future.result()
                finished(future.result())
        return [outcomes[i] for i in range(len(mutants))]

    @contextmanager
    def _copies(self) -> Iterator[SimpleQueue[Path]]:
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            copies: SimpleQueue[Path] = SimpleQueue()
            for number in range(self.processes):
                copy = Path(folder) / str(number)
                for name in self.copied:
                    _copy(self.root / name, copy / name)
                copies.put(copy)
            yield copies

    def _check_unmutated(self, target: str, tests: tuple[str, ...], copies: SimpleQueue[Path]) -> None:
        copy = copies.get()
        verdict, test, error = self._run_tests(copy, tests)
        copies.put(copy)
        if verdict != "survived":
            raise TestsFailUnmutatedError(f"{target}: {test or 'its tests'} without a mutation: {error or verdict}")

    def _outcome(self, target: str, mutant: Mutant, tests: tuple[str, ...], copies: SimpleQueue[Path]) -> Outcome:
        copy = copies.get()
        try:
            file = copy / mutant.path
            original = file.read_bytes()
            file.write_bytes(mutant.apply(original))
            verdict, test, error = self._run_tests(copy, tests)
            file.write_bytes(original)
            return Outcome(mutant, target, verdict, test, error)
        finally:
            copies.put(copy)

    def _run_tests(self, copy: Path, tests: tuple[str, ...]) -> tuple[Verdict, str, str]:
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_run_pytest, args=(str(copy), tests, sender), daemon=True)
        process.start()
        sender.close()
        if not receiver.poll(TIMEOUT_S):
            process.kill()
            process.join()
            return "timed out", "", f"no verdict after {TIMEOUT_S:.0f} s"
        try:
            failed, test, error = receiver.recv()
        except EOFError:
            failed, test, error = True, "", "the process ended without a verdict"
        process.join()
        return ("caught" if failed else "survived"), test, error


def _copy(source: Path, destination: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, destination, ignore=shutil.ignore_patterns("__pycache__", ".hypothesis"))
    else:
        destination.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, destination)


class _FirstFailure:
    """Pytest plugin that notes the first test that fails, and why."""

    def __init__(self) -> None:
        self.test = self.error = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._note(report)

    def pytest_collectreport(self, report: Any) -> None:
        self._note(report)

    def _note(self, report: Any) -> None:
        if report.failed and not self.test:
            self.test = report.nodeid
            crash = getattr(report.longrepr, "reprcrash", None)
            self.error = str(report.longrepr if crash is None else crash.message).strip().splitlines()[0]


def _run_pytest(copy: str, tests: tuple[str, ...], sender: Connection) -> None:
    """In a process of its own: the named tests against the copy; sends (failed, test, error)."""
    import pytest

    sys.dont_write_bytecode = True
    os.chdir(copy)
    # The copy must win over an installed package and over the checkout.
    sys.path.insert(0, copy)
    plugin = _FirstFailure()
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", f"--rootdir={copy}"]
        status = pytest.main([*options, *tests], plugins=[plugin])
    # An empty selection (5) or a usage error (4) is no verdict of the tests.
    error = plugin.error or ("" if status in (0, 1) else f"pytest ended with status {int(status)}")
    foreign = _imported_from_elsewhere(Path(copy))
    if foreign:
        sender.send((True, "", f"{foreign} was not imported from the copy"))
    else:
        sender.send((status != 0, plugin.test, error))
    sender.close()


def _imported_from_elsewhere(copy: Path) -> str:
    """Name of a module of the copied packages that came from another tree; empty where all is well."""
    packages = {path.name for path in copy.iterdir() if (path / "__init__.py").exists()}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.split(".")[0] in packages and file and copy.resolve() not in Path(file).resolve().parents:
            return name
    return ""
