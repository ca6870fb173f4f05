"""Runs mutants, each in a process of its own over a private copy of the tree; the checkout is never edited.

Processes are forked from a server that has PyTorch and pytest loaded already: a mutant costs its tests, not imports.
"""

from __future__ import annotations

import gc
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
from importlib.util import cache_from_source
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal

from jacobian_mutants.mutants import Mutant

# What every test file needs and no mutant changes; `torch.testing` imports the distributed tensors at first use.
_PRELOADED = ("pytest", "torch", "torch.distributed.tensor", "torch.autograd.gradcheck", "hypothesis.strategies")

Verdict = Literal["caught", "survived", "timed out", "no verdict"]
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
        self._context.set_forkserver_preload(list(_PRELOADED))

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
        targets = dict.fromkeys(target for target, _ in mutants)
        named = {target: tests_of[target] for target in targets}
        with self._copies(named) as copies, ThreadPoolExecutor(self.processes) as pool:
            futures = {
                pool.submit(self._outcome, target, mutant, named[target], copies): i
                for i, (target, mutant) in enumerate(mutants)
            }
            outcomes: dict[int, Outcome] = {}
            for future in as_completed(futures):
                outcomes[futures[future]] = future.result()
                finished(future.result())
        return [outcomes[i] for i in range(len(mutants))]

    @contextmanager
    def _copies(self, tests_of: dict[str, tuple[str, ...]]) -> Iterator[SimpleQueue[Path]]:
        """One copy of the tree a process, whose tests pass unmutated and are compiled already."""
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            first = Path(folder) / "0"
            for name in self.copied:
                _copy(self.root / name, first / name)
            for target, tests in tests_of.items():
                verdict, test, error = self._run_tests(first, tests, write_bytecode=True)
                if verdict != "survived":
                    raise TestsFailUnmutatedError(f"{target}: {test or 'tests'} without mutation: {error or verdict}")
            copies: SimpleQueue[Path] = SimpleQueue()
            copies.put(first)
            for number in range(1, self.processes):
                copies.put(Path(shutil.copytree(first, Path(folder) / str(number))))
            yield copies

    def _outcome(self, target: str, mutant: Mutant, tests: tuple[str, ...], copies: SimpleQueue[Path]) -> Outcome:
        copy = copies.get()
        try:
            file = copy / mutant.path
            original = file.read_bytes()
            file.write_bytes(mutant.apply(original))
            # Compiled code is told from its source by time and size, which a mutant may share with the original.
            Path(cache_from_source(str(file))).unlink(missing_ok=True)
            verdict, test, error = self._run_tests(copy, tests)
            file.write_bytes(original)
            return Outcome(mutant, target, verdict, test, error)
        finally:
            copies.put(copy)

    def _run_tests(self, copy: Path, tests: tuple[str, ...], write_bytecode: bool = False) -> tuple[Verdict, str, str]:
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(
            target=_run_pytest, args=(str(copy), tests, sender, write_bytecode), daemon=True
        )
        process.start()
        sender.close()
        if not receiver.poll(TIMEOUT_S):
            process.kill()
            process.join()
            return "timed out", "", f"no verdict after {TIMEOUT_S:.0f} s"
        try:
            answer: tuple[Verdict, str, str] = receiver.recv()
            return answer
        except EOFError:
            return "no verdict", "", "the process ended before its tests did"
        finally:
            process.join()


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


def _run_pytest(copy: str, tests: tuple[str, ...], sender: Connection, write_bytecode: bool) -> None:
    """In a process of its own: the named tests against the copy; sends (verdict, failed test, its error)."""
    import pytest

    # What the server loaded stays: collecting garbage among it would cost half a second a mutant.
    gc.freeze()
    sys.dont_write_bytecode = not write_bytecode
    os.chdir(copy)
    # The copy must win over an installed package and over the checkout.
    sys.path.insert(0, copy)
    plugin = _FirstFailure()
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        options = ["-x", "-q", f"--rootdir={copy}", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
        options += [option for name in ("cacheprovider", "xdist") for option in ("-p", f"no:{name}")]
        status = pytest.main([*options, *tests], plugins=[plugin])
    foreign = _imported_from_elsewhere(Path(copy))
    if foreign:
        sender.send(("no verdict", "", f"{foreign} was not imported from the copy"))
    elif plugin.test or status == 0:
        sender.send(("caught" if plugin.test else "survived", plugin.test, plugin.error))
    else:  # no tests selected, a usage error
        sender.send(("no verdict", "", f"pytest ended with status {int(status)}"))
    sender.close()


def _imported_from_elsewhere(copy: Path) -> str:
    """Name of a module of the copied packages that came from another tree; empty where all is well."""
    packages = {path.name for path in copy.iterdir() if (path / "__init__.py").exists()}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.split(".")[0] in packages and file and copy.resolve() not in Path(file).resolve().parents:
            return name
    return ""
