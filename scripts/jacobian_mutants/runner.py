"""Runs mutants: pytest runs the named tests once as they are, then a process is forked for each mutant.

In the fork the mutated function gets its changed code object, so that every module that imported it sees the mutant,
and the tests run until the first fails. Nothing is written: neither the checkout nor a copy of it is edited.
"""

from __future__ import annotations

import io
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Literal

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
    import pytest

    # Imported here, and not in the server of processes, which has to stay free of what mutants change.
    from jacobian_mutants.forked_tests import ForkedTests

    os.chdir(job.root)
    plugin = ForkedTests(job, sender)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        options = ["-q", f"--rootdir={job.root}", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
        options += [option for name in ("cacheprovider", "xdist") for option in ("-p", f"no:{name}")]
        pytest.main([*options, *job.tests], plugins=[plugin])
    if plugin.collection_error:
        sender.send(("no verdict", "", plugin.collection_error))
    sender.close()
