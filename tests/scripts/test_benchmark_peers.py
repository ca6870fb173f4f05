"""Peers minimise the library's own energy, and what is timed as its loops alone are the loops of a call."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec

import benchmark
import numpy as np
import pytest
import torch
from benchmark_suites import peers, workloads
from benchmark_suites.loops_alone import loops_row, recorded_loops
from benchmark_suites.peers import LeastSquares, peer_rows
from helpers.car_counts import first_cars
from torch.autograd.functional import jacobian

from directshape_torch import DirectShapeRefiner
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels import silhouettes

SCENE = workloads.demo_scene()
CALL = collate([first_cars(SCENE.frames[0], 2)])


@pytest.fixture(autouse=True)
def no_graph() -> Iterator[None]:
    with torch.no_grad():
        yield


def test_squares_have_the_gradient_and_the_matrix_of_the_energy_after_a_move_too() -> None:
    problem, start = DirectShapeRefiner().problem(*CALL)
    prepared = problem.prepare(start)
    iterations, at = problem.begin(0, prepared).start(prepared)
    car = LeastSquares(iterations, at, start, 1)
    step = 0.01 * torch.ones_like(car.nowhere)
    moved = iterations.stage.retract(start, step.expand(2, -1))
    for there in (at, iterations.evaluate(moved, at)):
        J = jacobian(car.residuals, car.nowhere, vectorize=True, strategy="forward-mode")[0, :, 0]
        gradient, matrix = J.T @ car.residuals(car.nowhere)[0], J.T @ J
        assert (gradient - there.gradient[1]).abs().max() < 1e-4 * there.gradient[1].abs().max()
        assert (matrix - there.hessian[1]).abs().max() < 1e-4 * there.hessian[1].abs().max()
        car.move(step)


def test_loops_that_are_repeated_write_the_same_numbers() -> None:
    original = silhouettes.silhouettes
    refiner = DirectShapeRefiner()
    refiner(*CALL)
    with recorded_loops() as record:
        refiner(*CALL)
    assert silhouettes.silhouettes is original
    arguments = next(arguments for loop, arguments in record.calls if loop is original)
    written = arguments[-1].residual
    before = written.copy()
    written[...] = -1
    original(*arguments)
    np.testing.assert_array_equal(written, before)


def test_loops_alone_are_a_part_of_a_call() -> None:
    row = loops_row("one frame", [CALL], 1)
    share, counts = float(row.note.split()[0]), row.note.split("; ")[1].split(", ")
    assert 0 < share < 1
    assert [count.split()[2] for count in counts] == ["march", "silhouettes", "photometric"]
    assert all(int(count.split()[0]) > 2 for count in counts)
    assert all(int(count.partition("(")[2].partition(" rows")[0]) > 1000 for count in counts)


def test_a_missing_peer_is_told_with_its_cure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pypose", None)
    assert benchmark.main(["--peers"]) != 0
    assert "pip install 'directshape_torch[peers]'" in capsys.readouterr().err


@pytest.mark.skipif(not (find_spec("pypose") and find_spec("theseus")), reason="the peers are not installed")
# Theseus takes tensors for arrays in a way that NumPy 2 disapproves of.
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_peers_end_where_the_library_does(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = replace(SCENE, frames=(first_cars(SCENE.frames[0], 1),))
    monkeypatch.setattr(peers, "load_scenes", lambda *_: (scene,))
    rows = list(peer_rows(None, quick=True))
    assert [row.name.split(", ")[2].partition(":")[0] for row in rows] == [
        "loops alone",
        "native loops",
        "tensor operations",
        "forward mode",
        "PyPose",
        "Theseus",
    ]
    assert all("0 of 1 cars higher, 0 lower" in row.note for row in rows[1:])
