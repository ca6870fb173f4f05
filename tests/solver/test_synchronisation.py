"""The host reads one number a block of iterations and sends none: by the names of operations, and on a GPU itself."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from helpers.host_traffic import host_traffic
from helpers.quadratics import Energy, Vector, VectorProblem
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.solver import gauss_newton
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.solver.iteration import begin, iterate
from directshape_torch.terms.cars import CarState, retract

DAMPED = SolverConfig(cost_tolerance=1e-12)
PURE = SolverConfig(initial_damping=0.0, accept_every_step=True)
READ = "aten._local_scalar_dense"


class Valleys(VectorProblem):
    """Rosenbrock's valley, of another steepness for each problem, so that they converge one after the other."""

    def __init__(self, steep: Tensor, stages: Sequence[StageConfig], compactions: list[int]) -> None:
        super().__init__(stages, num_unknowns=2, limit=1.0)
        self.steep, self.compactions = steep, compactions
        self.limits = torch.ones(2, dtype=torch.float64, device=steep.device)

    def energy(self, x: Tensor) -> Energy:
        along, across = x.unbind(1)
        zero = torch.zeros_like(along)
        r = torch.stack([1 - along, self.steep * (across - along * along)], dim=1)
        J = torch.stack([zero - 1, zero, -2 * self.steep * along, self.steep], dim=1).view(-1, 2, 2)
        return Energy(0.5 * (r * r).sum(1), torch.bmm(J.mT, r[..., None])[..., 0], torch.bmm(J.mT, J), x)

    def step_limits(self) -> Tensor:
        return self.limits

    def part(self, index: Tensor) -> Valleys:
        self.compactions.append(len(index))
        return Valleys(self.steep[index], self.stage_configs, self.compactions)


def _run(device: str, count: int = 6, iterations: int = 12, num_stages: int = 1) -> tuple[Valleys, Vector]:
    steep = torch.linspace(1.0, 12.0, count, dtype=torch.float64, device=device)
    problem = Valleys(steep, [StageConfig(1.0, 0, iterations)] * num_stages, [])
    return problem, Vector(torch.full((count, 2), -1.3, dtype=torch.float64, device=device))


@pytest.mark.parametrize("config", [DAMPED, PURE], ids=["damped", "pure"])
@pytest.mark.parametrize("block", [1, 4, 12])
@pytest.mark.parametrize("num_stages", [1, 2])
def test_a_block_is_read_once_and_sends_nothing(
    config: SolverConfig, block: int, num_stages: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, reads = gauss_newton._read, list[int]()

    def counted(ended: Tensor) -> list[int]:
        reads.append(len(ended))
        return read(ended)

    monkeypatch.setattr(gauss_newton, "_read", counted)
    problem, start = _run("cpu", num_stages=num_stages)
    # It fails at once, and a second stage begins without it: the host has read that already.
    problem.steep[2] = torch.nan
    minima: list[Minimum[Vector]] = []
    config = replace(config, block_iterations=block)
    traffic = host_traffic(lambda: minima.append(minimise(problem, start, config, record=True)))
    iterations = Counter(iteration.stage for iteration in minima[0].trajectory)
    assert len(iterations) == num_stages
    blocks = sum(-(-done // block) for done in iterations.values())
    assert traffic.found == []
    assert len(reads) == blocks
    if block == 1 and not config.accept_every_step:
        assert len(problem.compactions) > 2


def test_the_number_of_operations_of_an_iteration() -> None:
    """A guard: beside linearisation and retraction an iteration takes about ninety; more, and a frame feels it."""
    counts = []
    for iterations in (4, 8):
        problem, start = _run("cpu", iterations=iterations)
        config = replace(DAMPED, cost_tolerance=0.0, step_tolerance=0.0, block_iterations=100)
        counts.append(host_traffic(lambda: minimise(problem, start, config)).operations)  # noqa: B023
    own = host_traffic(lambda: problem.retract(start, problem.energy(start.x).gradient)).operations
    assert (counts[1] - counts[0]) / 4 - own <= 95


def test_the_state_of_cars_moves_without_the_host() -> None:
    state = CarState.of(torch.eye(4).expand(3, 4, 4).clone(), torch.zeros(3, 5))
    step = torch.full((3, 11), 0.1, dtype=torch.float64)
    retract(state, step, 3.0)  # makes its constants, once
    assert host_traffic(lambda: retract(state, step, 3.0)).found == []


_KNOWN: dict[str, tuple[Callable[[Tensor], object], str]] = {
    "a number": (lambda x: float(x.sum()), READ),
    "places": (lambda x: (x > 0).nonzero(), "aten.nonzero"),
    "a mask": (lambda x: x[x > 0], "aten.index"),
    "a mask that is written to": (lambda x: x.__setitem__(x > 0, x[:1]), "aten.index_put_"),
    "repetitions": (lambda x: x.repeat_interleave(x.long()), "aten.repeat_interleave"),
    "distinct values": (lambda x: x.unique(), "aten._unique2"),
    "Python numbers": (lambda x: x + torch.tensor([1.0, 2.0, 3.0]), "aten.lift_fresh"),
}


@pytest.mark.parametrize("name", _KNOWN)
def test_the_traffic_is_found(name: str) -> None:
    call, expected = _KNOWN[name]
    assert host_traffic(lambda: call(torch.tensor([1.0, 2.0, 3.0]))).found.count(expected) >= 1
    assert host_traffic(lambda: torch.zeros(3).index_fill(0, torch.arange(2), 1.0)[torch.arange(2)]).found == []


needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


@needs_gpu
@pytest.mark.parametrize("config", [DAMPED, PURE], ids=["damped", "pure"])
def test_an_iteration_on_a_gpu_never_waits(config: SolverConfig) -> None:
    problem, state = _run("cuda")
    ended = torch.full((6,), -1, device="cuda")
    with torch.no_grad():
        at_state = problem.energy(state.x)
        iterate(problem, begin(state, at_state, ended, config), config, problem.limits)
        before = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            progress = begin(state, at_state, ended, config)
            for _ in range(5):
                iterate(problem, progress, config, problem.limits)
        finally:
            torch.cuda.set_sync_debug_mode(before)
    assert progress.iterations.tolist() == [5] * 6


@needs_gpu
@pytest.mark.parametrize("block", [1, 4])
def test_blocks_on_a_gpu_wait_once(block: int) -> None:
    config = replace(DAMPED, block_iterations=block)
    problem, start = _run("cuda")
    minimise(problem, start, config)
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            minimum = minimise(problem, start, config)
    finally:
        torch.cuda.set_sync_debug_mode(before)
    waits = [warning for warning in caught if "synchronizing" in str(warning.message)]
    assert len(waits) == -(-minimum.cost_history.shape[1] // block)
