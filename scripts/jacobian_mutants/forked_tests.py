"""Pytest plugin: instead of running the collected tests once, runs them in a fork for each mutant."""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import signal
import sys
import warnings
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

from jacobian_mutants.mutants import Mutant
from jacobian_mutants.runner import Job, Verdict

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
