"""This module runs mutants: pytest runs the named tests once unchanged, then a process is forked for each mutant.

In the fork the mutated function gets its changed code object, so that every module that imported it uses the mutant,
and the tests run until the first failure. Nothing is written: neither the checkout nor a copy of it is edited.
"""

from __future__ import annotations

import gc
import importlib
import io
import multiprocessing
import os
import signal
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Literal, NamedTuple

import pytest

from jacobian_mutants.mutants import Mutant

Verdict = Literal["caught", "survived", "timed out", "no verdict"]
# This number of mutants shares one collection of tests.
_CHUNK = 40
# Every test file needs these and no mutant changes them; `torch.testing` imports the distributed tensors on first use.
_PRELOADED = ("pytest", "torch", "torch.distributed.tensor", "torch.autograd.gradcheck", "hypothesis.strategies")


@dataclass(frozen=True)
class Outcome:
    """An `Outcome` is the result of the named tests for a mutant."""

    mutant: Mutant
    target: str
    verdict: Verdict
    caught_by: str  # path::test, or empty
    error: str  # first line of the test's report: a wrong number, or a crash


class Job(NamedTuple):
    """A `Job` has mutants of one file that the same tests must catch, for one collecting process."""

    root: Path
    target: str
    tests: tuple[str, ...]
    source: bytes  # of the file without a mutation
    mutants: tuple[Mutant, ...]


class UnmutatedFailureError(Exception):
    """The tests named for a target fail, or could not run, without any mutation."""


def run_mutants(
    root: Path,
    mutants: Sequence[tuple[str, Mutant]],
    tests_of: Mapping[str, tuple[str, ...]],
    processes: int,
    finished: Callable[[Outcome], None],
) -> list[Outcome]:
    """Outcomes in the order of `mutants` (target, mutant), after a check that the tests pass without mutation.

    Args:
        root: tree of the sources and `tests`.
        mutants: targets and their mutants.
        tests_of: the tests named for a target.
        processes: number of mutants that run at once.
        finished: function that is told of each outcome.

    Raises:
        UnmutatedFailureError: the tests of a target fail without a mutation.
    """
    jobs = []
    for target in dict.fromkeys(target for target, _ in mutants):
        own = [mutant for name, mutant in mutants if name == target]
        source = (root / own[0].path).read_bytes()
        chunks = (tuple(own[i : i + _CHUNK]) for i in range(0, len(own), _CHUNK))
        jobs += [Job(root, target, tests_of[target], source, chunk) for chunk in chunks]
    # The variable is set before the server of processes starts, because its children inherit it.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_PRELOADED))
    outcomes: list[Outcome] = []
    # Each job has its own process, because modules stay imported.
    with ProcessPoolExecutor(processes, mp_context=context, max_tasks_per_child=1) as pool:
        try:
            for part in pool.map(_collect_and_fork, jobs):
                outcomes += part
                for outcome in part:
                    finished(outcome)
        except UnmutatedFailureError:
            pool.shutdown(cancel_futures=True)
            raise
    return outcomes


def _collect_and_fork(job: Job) -> list[Outcome]:
    """In a separate process, run the tests without a mutation, then once for each mutant."""
    os.chdir(job.root)
    plugin = ForkedTests(job)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        # Mutants are run on the whole of each sweep, of which the suite has a short form.
        options = ["-q", "-m", "", f"--rootdir={job.root}", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
        options += [option for name in ("cacheprovider", "xdist") for option in ("-p", f"no:{name}")]
        pytest.main([*options, *job.tests], plugins=[plugin])
    if plugin.trouble:
        raise UnmutatedFailureError(f"{job.target}: {plugin.trouble}")
    return plugin.outcomes


# A mutant may loop for ever. The slowest named tests take seconds, on a busy machine a minute.
TIMEOUT_S = 240.0


class ForkedTests:
    """A `ForkedTests` is a pytest plugin with the outcomes of a job's mutants, or the trouble without a mutation."""

    def __init__(self, job: Job) -> None:
        self._job, self.outcomes = job, list[Outcome]()
        self._failed = self._error = ""
        self.trouble = "pytest ended before it had collected the tests"
        # The tree must take precedence over an installed package.
        sys.path.insert(0, str(job.root))

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self.trouble = f"{report.nodeid} cannot be imported: {_first_line(report)}"

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self._failed:
            self._failed, self._error = report.nodeid, _first_line(report)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed or not session.items:
            return True
        # The run without a mutation must pass; it also leaves imports and rendered scenes in memory for the forks.
        verdict, test, error = self._run(session)
        self.trouble = "" if verdict == "survived" else f"{test} without a mutation: {error}"
        if not self.trouble:
            # Forks then do not collect garbage in existing objects, which would copy their memory.
            gc.freeze()
            for mutant in self._job.mutants:
                self.outcomes.append(Outcome(mutant, self._job.target, *self._verdict(session, mutant)))
        return True

    def _verdict(self, session: pytest.Session, mutant: Mutant) -> tuple[Verdict, str, str]:
        receiver, sender = multiprocessing.Pipe(duplex=False)
        child = os.fork()
        if child == 0:
            try:
                sender.send(self._run_mutated(session, mutant))
            finally:
                os._exit(0)
        sender.close()
        try:
            if not receiver.poll(TIMEOUT_S):
                os.kill(child, signal.SIGKILL)
                return "timed out", "", f"no verdict after {TIMEOUT_S:.0f} s"
            answer: tuple[Verdict, str, str] = receiver.recv()
            return answer
        except EOFError:
            return "no verdict", "", "the process of the mutant ended before its tests did"
        finally:
            os.waitpid(child, 0)

    def _run_mutated(self, session: pytest.Session, mutant: Mutant) -> tuple[Verdict, str, str]:
        try:
            put_into_effect(mutant, self._job.source, self._job.root)
        except (LookupError, ValueError) as error:
            return "no verdict", "", str(error)
        return self._run(session)

    def _run(self, session: pytest.Session) -> tuple[Verdict, str, str]:
        for item, following in zip(session.items, [*session.items[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if self._failed:
                return "caught", self._failed, self._error
        return "survived", "", ""


def put_into_effect(mutant: Mutant, source: bytes, root: Path) -> None:
    """Give the mutated function of the imported module the mutant's code.

    Raises:
        ValueError: the module was imported from another tree, or its file has changed since `source` was read.
        LookupError: the module has no such function.
    """
    module = importlib.import_module(mutant.path.removesuffix(".py").replace("/", "."))
    file = str(module.__file__)
    if Path(file).resolve() != (root / mutant.path).resolve():
        raise ValueError(f"{mutant.path} was imported from {file}")
    function = function_of(module, mutant.function)
    if _code_of(source, file, mutant.function).co_code != function.__code__.co_code:
        raise ValueError(f"{mutant.path} has changed since its mutants were made")
    function.__code__ = _code_of(mutant.apply(source), file, mutant.function)


def function_of(module: object, qualified_name: str) -> FunctionType:
    """The plain function behind decorators, properties and static methods."""
    owner = module
    *classes, name = qualified_name.split(".")
    for part in classes:
        owner = getattr(owner, part)
    found: Any = vars(owner)[name]
    if isinstance(found, property):
        found = found.fget
    elif isinstance(found, cached_property):
        found = found.func
    elif isinstance(found, staticmethod | classmethod):
        found = found.__func__
    while hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    if not isinstance(found, FunctionType):
        raise LookupError(f"{qualified_name} is no function")
    return found


def _code_of(source: bytes, file: str, qualified_name: str) -> CodeType:
    def search(code: CodeType) -> CodeType | None:
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                if constant.co_qualname == qualified_name:
                    return constant
                deeper = search(constant)
                if deeper is not None:
                    return deeper
        return None

    # A mutant such as `(1)[:, None]` raises a warning; the tests decide whether it fails.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)
        found = search(compile(source, file, "exec"))
    if found is None:
        raise LookupError(f"{file} has no function {qualified_name}")
    return found


def _first_line(report: Any) -> str:
    crash = getattr(report.longrepr, "reprcrash", None)
    return str(report.longrepr if crash is None else crash.message).strip().splitlines()[0]
