"""The host reads one number a block of iterations and sends none: by the names of operations, and on a GPU itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from helpers.host_traffic import host_traffic
from helpers.quadratics import Vector
from torch import Tensor

from directshape_torch.benchmark.synchronisations import count_synchronisations
from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.solver import gauss_newton
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.solver.iteration import begin, iterate
from directshape_torch.solver.problem import Linearisation

DAMPED = SolverConfig(cost_tolerance=1e-12)
PURE = SolverConfig(initial_damping=0.0, accept_every_step=True)
READ = "aten._local_scalar_dense"


class Valleys:
    """Rosenbrock's valley, of another steepness for each problem, so that they converge one after the other."""

    def __init__(self, steep: Tensor, iterations: int, num_stages: int) -> None:
        self.steep, self.iterations, self.num_stages = steep, iterations, num_stages
        self.limits = torch.ones(2, dtype=torch.float64, device=steep.device)
        self.compactions: list[int] = []

    def stages(self) -> list[StageConfig]:
        return [StageConfig(1.0, 0, self.iterations)] * self.num_stages

    def begin_stage(self, stage: StageConfig, state: Vector) -> Valleys:
        """Nothing is fixed."""
        return self

    def cost(self, state: Vector) -> Tensor:
        return self.linearise(state).cost

    def linearise(self, state: Vector) -> Linearisation:
        x, y = state.x.unbind(1)
        zero = torch.zeros_like(x)
        r = torch.stack([1 - x, self.steep * (y - x * x)], dim=1)
        J = torch.stack([zero - 1, zero, -2 * self.steep * x, self.steep], dim=1).view(-1, 2, 2)
        return Linearisation(0.5 * (r * r).sum(1), torch.bmm(J.mT, r[..., None])[..., 0], torch.bmm(J.mT, J))

    def follow(self, accepted: Tensor) -> None:
        """Nothing is tracked."""

    def retract(self, state: Vector, step: Tensor) -> Vector:
        return Vector(state.x + step)

    def step_limits(self) -> Tensor:
        return self.limits

    def compact(self, keep: Tensor, numbers: Sequence[int]) -> Valleys:
        part = Valleys(self.steep[keep], self.iterations, self.num_stages)
        part.compactions = self.compactions
        part.compactions.append(len(part.steep))
        return part


def _run(device: str, count: int = 6, iterations: int = 12, num_stages: int = 1) -> tuple[Valleys, Vector]:
    problem = Valleys(torch.linspace(1.0, 12.0, count, dtype=torch.float64, device=device), iterations, num_stages)
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
    # The masks are this problem's own way to leave problems out, once a compaction.
    assert traffic.found == ["aten.index"] * len(problem.compactions)
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
    own = host_traffic(lambda: problem.retract(start, problem.linearise(start).gradient)).operations
    assert (counts[1] - counts[0]) / 4 - own <= 95


def test_the_state_of_cars_moves_without_the_host() -> None:
    state = CarState(torch.eye(4).expand(3, 4, 4).clone(), torch.zeros(3, 5))
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
        iterate(problem, begin(problem, state, ended, config), config, problem.limits)
        before = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            progress = begin(problem, state, ended, config)
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
    minima: list[Minimum[Vector]] = []
    minimise(problem, start, config)
    problem.compactions.clear()
    counted = count_synchronisations(lambda: minima.append(minimise(problem, start, config)))
    blocks = -(-minima[0].cost_history.shape[1] // block)
    assert counted.total == blocks + len(problem.compactions)
