"""Runs mutants: pytest runs the named tests once as they are, then a process is forked for each mutant.

In the fork the mutated function gets its changed code object, so that every module that imported it sees the mutant,
and the tests run until the first fails. Nothing is written: neither the checkout nor a copy of it is edited.
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
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Literal

import pytest

from jacobian_mutants.mutants import Mutant

Verdict = Literal["caught", "survived", "timed out", "no verdict"]
# How many mutants share one collection of tests.
_CHUNK = 40
# What every test file needs and no mutant changes; `torch.testing` imports the distributed tensors at first use.
_PRELOADED = ("pytest", "torch", "torch.distributed.tensor", "torch.autograd.gradcheck", "hypothesis.strategies")


@dataclass(frozen=True)
class Outcome:
    """What the named tests said of a mutant."""

    mutant: Mutant
    target: str
    verdict: Verdict
    caught_by: str  # path::test, or empty
    error: str  # first line of what the test reported: a wrong number, or a crash


@dataclass(frozen=True)
class Job:
    """Mutants of one file that the same tests must catch; what a collecting process gets."""

    root: str
    tests: tuple[str, ...]
    source: bytes  # of the file without a mutation
    mutants: tuple[Mutant, ...]


class UnmutatedFailureError(Exception):
    """The tests named for a target fail, or could not be run, without any mutation."""


class MutationRunner:
    """Runs mutants of a tree.

    Args:
        root: the tree that holds the sources and `tests`.
        processes: how many mutants run at once.
    """

    def __init__(self, root: Path, processes: int = 2) -> None:
        self.root, self.processes = root, processes
        # Before the server of processes starts: its children inherit it.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(list(_PRELOADED))

    def run(
        self,
        mutants: Sequence[tuple[str, Mutant]],
        tests_of: dict[str, tuple[str, ...]],
        finished: Callable[[Outcome], None],
    ) -> list[Outcome]:
        """Outcomes in the order of `mutants` (target, mutant); also checks that the tests pass unmutated.

        Raises:
            UnmutatedFailureError: the tests of a target fail without a mutation.
        """
        chunks: list[tuple[str, list[Mutant]]] = []
        for target in dict.fromkeys(target for target, _ in mutants):
            own = [mutant for name, mutant in mutants if name == target]
            chunks += [(target, own[i : i + _CHUNK]) for i in range(0, len(own), _CHUNK)]
        with ThreadPoolExecutor(self.processes) as pool:
            try:
                done = pool.map(lambda chunk: self._run_chunk(chunk[0], chunk[1], tests_of[chunk[0]], finished), chunks)
                return [outcome for outcomes in done for outcome in outcomes]
            except UnmutatedFailureError:
                pool.shutdown(cancel_futures=True)
                raise

    def _run_chunk(
        self, target: str, mutants: list[Mutant], tests: tuple[str, ...], finished: Callable[[Outcome], None]
    ) -> list[Outcome]:
        source = (self.root / mutants[0].path).read_bytes()
        job = Job(str(self.root), tests, source, tuple(mutants))
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_collect_and_fork, args=(job, sender))
        process.start()
        sender.close()
        verdict, test, error = _received(receiver)
        if verdict != "survived":
            raise UnmutatedFailureError(f"{target}: {test or 'tests'} without a mutation: {error or verdict}")
        outcomes = []
        for mutant in mutants:
            outcomes.append(Outcome(mutant, target, *_received(receiver)))
            finished(outcomes[-1])
        process.join()
        return outcomes


def _received(receiver: Connection) -> tuple[Verdict, str, str]:
    try:
        answer: tuple[Verdict, str, str] = receiver.recv()
    except EOFError:
        return "no verdict", "", "the process that runs the tests ended"
    return answer


def _collect_and_fork(job: Job, sender: Connection) -> None:
    """In a process of its own: sends the verdict of a job's tests without a mutation, then one for each mutant."""
    os.chdir(job.root)
    plugin = ForkedTests(job, sender)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        options = ["-q", f"--rootdir={job.root}", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
        options += [option for name in ("cacheprovider", "xdist") for option in ("-p", f"no:{name}")]
        pytest.main([*options, *job.tests], plugins=[plugin])
    if plugin.collection_error:
        sender.send(("no verdict", "", plugin.collection_error))
    sender.close()


# A mutant may loop for ever; the slowest named tests take seconds, on a busy machine a minute.
TIMEOUT_S = 240.0


class ForkedTests:
    """Sends (verdict, failed test, its error) for the unmutated code where asked for, then for each mutant."""

    def __init__(self, job: Job, sender: Connection) -> None:
        self._job, self._sender = job, sender
        self._failed = self._error = ""
        self.collection_error = "pytest ended before it had collected the tests"
        # The tree must win over an installed package.
        sys.path.insert(0, job.root)

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self.collection_error = f"{report.nodeid} cannot be imported: {_first_line(report)}"

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self._failed:
            self._failed, self._error = report.nodeid, _first_line(report)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed or not session.items:
            return True
        self.collection_error = ""
        # Once without a mutation: it must pass, and leaves imports and rendered scenes in memory for the forks.
        self._sender.send(self._run(session))
        if self._failed:
            return True
        # A fork need not look for garbage in what is loaded by now, nor copy it by doing so.
        gc.freeze()
        for mutant in self._job.mutants:
            self._sender.send(self._verdict(session, mutant))
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
            put_into_effect(mutant, self._job.source, Path(self._job.root))
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
        LookupError: it has no such function.
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

    # A mutant such as `(1)[:, None]` is warned of; that it fails is for the tests to say.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)
        found = search(compile(source, file, "exec"))
    if found is None:
        raise LookupError(f"{file} has no function {qualified_name}")
    return found


def _first_line(report: Any) -> str:
    crash = getattr(report.longrepr, "reprcrash", None)
    return str(report.longrepr if crash is None else crash.message).strip().splitlines()[0]
