"""This module takes the steps of `solver.iteration.iterate` for cars that share no unknowns, car by car.

An iteration is a call of `propose`, the loops of all terms at the candidate states, and a call of `decide`.
"""

from __future__ import annotations

import numpy as np

from directshape_torch.geometry.se3 import EXP_SERIES
from directshape_torch.kernels.arguments import (
    BlockSums,
    Doubles,
    Energies,
    Family,
    Flags,
    Index,
    Iterated,
    Reals,
    Rules,
    StageRun,
    States,
    Steps,
    Turn,
)
from directshape_torch.kernels.grid import cross, dot, plus
from directshape_torch.kernels.jit import SOURCES, loop, step


@loop
def propose(run: StageRun, _sources: int = SOURCES) -> None:
    """Write the candidate states of cars that still move, with their steps and the values of their grids."""
    rules, at, family = run.rules, run.at, run.family
    factor = np.empty((len(rules.held), len(rules.held)))
    for car in range(np.uint64(len(run.rest))):
        if not run.turn.moving[car]:
            continue
        move, damping = run.steps.step[car], run.progress.damping[car]
        run.steps.solvable[car] = solve(rules, at.hessian[car], at.gradient[car], damping, factor, move)
        length, size = rules.over_relaxation if run.progress.stretched[car] else 1.0, 0.0
        for k in range(len(move)):
            move[k] *= length
            size = max(size, abs(move[k]) / rules.largest_step[k])
        for k in range(len(move)):
            move[k] /= max(size, 1.0)
        run.steps.size[car] = size
        write_moved(rules, car, move, run.state, run.candidate)
        write_values(family, run.candidate.code[car], car * np.uint64(len(family.mean)))


@step
def solve(
    rules: Rules, hessian: Doubles, gradient: Doubles, damping: float, factor: Doubles, solution: Doubles
) -> bool:
    """Write the solution of the damped system, or zeros, and tell whether it has one (`damped_solve.damped_step`)."""
    size, largest = len(gradient), 0.0
    for i in range(size):
        largest = max(largest, hessian[i, i])
    # The scales wait in the solution until the system is scaled.
    for i in range(size):
        solution[i] = 1.0 / np.sqrt(max(hessian[i, i], rules.least_diagonal * largest))
    for i in range(size):
        for k in range(i + 1):
            factor[i, k] = hessian[i, k] * solution[i] * solution[k]
        factor[i, i] += damping
    for k in range(size):
        for i in range(k, size):
            total = factor[i, k]
            for j in range(k):
                total -= factor[i, j] * factor[k, j]
            factor[i, k] = np.sqrt(total) if i == k else total / factor[k, k]
        # A comparison with NaN is false.
        if not factor[k, k] > rules.least_pivot:
            return without_solution(solution)
    return substitute(factor, gradient, solution)


@step
def without_solution(solution: Doubles) -> bool:
    for i in range(len(solution)):
        solution[i] = 0.0
    return False


@step
def substitute(factor: Doubles, gradient: Doubles, solution: Doubles) -> bool:
    """Write the step from the factor of the scaled system, whose scales are in `solution`."""
    size = len(gradient)
    scaled = np.empty(size)
    for i in range(size):
        total = -gradient[i] * solution[i]
        for j in range(i):
            total -= factor[i, j] * scaled[j]
        scaled[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            scaled[i] -= factor[j, i] * scaled[j]
        scaled[i] /= factor[i, i]
    total = 0.0
    for i in range(size):
        solution[i] *= scaled[i]
        total += solution[i]
    return True if np.isfinite(total) else without_solution(solution)


@step
def write_values(family: Family, code: Reals, first: Index) -> None:
    """Write the grid of a car, a part at a time that stays in the processor's first cache."""
    mean, values, part = family.mean, family.values, np.uint64(1024)
    for start in range(np.uint64(0), np.uint64(len(mean)), part):
        end = min(start + part, np.uint64(len(mean)))
        for node in range(start, end):
            values[first + node] = mean[node]
        for k in range(np.uint64(len(code))):
            factor, column = code[k], family.basis[k]
            for node in range(start, end):
                values[first + node] += factor * column[node]


@step
def write_moved(rules: Rules, car: Index, move: Doubles, state: States, candidate: States) -> None:
    """Write the state after a step (`Unknowns.retract`)."""
    columns, T, moved = rules.columns, state.T_obj_cam[car], candidate.T_obj_cam[car]
    of_pose = move[columns.of_pose :]
    v, w = (of_pose[0], of_pose[1], of_pose[2]), (of_pose[3], of_pose[4], of_pose[5])
    angle_squared = dot(w, w)
    second, third = 0.0, 0.0
    for coefficients in EXP_SERIES:
        second, third = coefficients[0] - second * angle_squared, coefficients[1] - third * angle_squared
    for column in range(4):
        point = (np.float64(T[0, column]), np.float64(T[1, column]), np.float64(T[2, column]))
        across = cross(w, point)
        # With the matrix W of w, the rotation is I + W + second W^2 + third W^3, and W^3 = -angle^2 W.
        point = plus(plus(point, 1.0 - third * angle_squared, across), second, cross(w, across))
        if column == 3:
            across = cross(w, v)
            point = plus(plus(plus(point, 1.0, v), second, across), third, cross(w, across))
        moved[0, column], moved[1, column], moved[2, column] = point
        moved[3, column] = T[3, column]
    for k in range(state.code.shape[1]):
        code = state.code[car, k] + move[columns.of_code + k]
        candidate.code[car, k] = min(max(code, -rules.max_code), rules.max_code)
    for k in range(state.offset_px.shape[1]):
        candidate.offset_px[car, k] = state.offset_px[car, k] + move[columns.of_offset + k]


@loop
def decide(
    run: StageRun, terms: tuple[BlockSums, ...], has_run: Flags, costs: Doubles, _sources: int = SOURCES
) -> None:
    """Move the cars whose cost falls to their candidates, and end those that are done.

    Whether each car took part is written to `has_run` (B,), and its cost to `costs` (B,).
    """
    turn = run.turn
    add_up(run.rules, terms, run.rest, turn, run.at_candidate)
    for car in range(np.uint64(len(run.rest))):
        has_run[car] = turn.moving[car]
        if turn.moving[car]:
            accepted = judge(run.rules, car, run.at, run.at_candidate, run.steps, run.progress)
            if accepted:
                move_on(car, run.candidate, run.state, run.at_candidate, run.at)
            turn.taken[car], turn.moving[car] = accepted, run.progress.ended[car] < 0
        costs[car] = run.at.cost[car]


@step
def add_up(rules: Rules, terms: tuple[BlockSums, ...], rest: Doubles, turn: Turn, out: Energies) -> None:
    """Write the sums over all blocks of each car, and let unknowns that the stage fixes rest."""
    for car in range(np.uint64(len(rest))):
        out.cost[car] = rest[car]
        for i in range(len(rules.held)):
            out.gradient[car, i] = 0.0
            for k in range(len(rules.held)):
                out.hessian[car, i, k] = 0.0
    for blocks in terms:
        for number in range(np.uint64(len(blocks.owner))):
            owner, weight = np.uint64(blocks.owner[number]), blocks.weight[number]
            if turn.moving[owner]:
                products, gradient, hessian = blocks.products[number], out.gradient[owner], out.hessian[owner]
                out.cost[owner] += weight * blocks.cost[number]
                for i in range(len(gradient)):
                    gradient[i] += weight * products[len(gradient), i]
                    for k in range(len(gradient)):
                        hessian[i, k] += weight * products[i, k]
    for car in range(np.uint64(len(rest))):
        for i in range(len(rules.held)):
            for k in range(len(rules.held)):
                if rules.held[i] or rules.held[k]:
                    out.hessian[car, i, k] = 1.0 if i == k else 0.0
            if rules.held[i]:
                out.gradient[car, i] = 0.0


@step
def judge(rules: Rules, car: Index, at: Energies, new: Energies, steps: Steps, progress: Iterated) -> bool:
    """Write what an iteration changes in the progress of a car, and tell whether its step is accepted."""
    solvable, stretched = bool(steps.solvable[car]), bool(progress.stretched[car])
    total, promised = new.cost[car], 0.0
    for i in range(len(rules.held)):
        total += new.gradient[car, i]
        promised -= 0.5 * at.gradient[car, i] * steps.step[car, i]
        for k in range(len(rules.held)):
            total += new.hessian[car, i, k]
    takeable = solvable and bool(np.isfinite(total))
    decrease = at.cost[car] - new.cost[car]
    accepted = takeable and bool(decrease >= 0.0)
    at_limit = bool(progress.damping[car] >= rules.most_damping)
    little = rules.cost_tolerance * abs(at.cost[car])
    small = bool(decrease <= little)
    has_settled, exhausted = accepted and small, at_limit and not accepted
    if rules.over_relaxation != 1.0:
        changes_little = bool(promised <= rules.flat * little and -decrease <= rules.flat * little)
        at_rest = takeable and changes_little and not accepted
        has_settled = (has_settled or at_rest) and not stretched
        exhausted = exhausted and not stretched
        progress.stretched[car] = accepted and not small
    progress.iterations[car] += 1
    if solvable and (steps.size[car] < rules.step_tolerance or has_settled or exhausted):
        progress.ended[car] = rules.converged
    if not solvable and (at_limit or not rules.changes_damping):
        progress.ended[car] = rules.singular
    if rules.changes_damping:
        damping = float(progress.damping[car])
        smaller, larger = damping * rules.damping_decrease, damping * rules.damping_increase
        progress.damping[car] = max(smaller, rules.least_damping) if accepted else min(larger, rules.most_damping)
    return accepted


@step
def move_on(car: Index, candidate: States, state: States, at_candidate: Energies, at: Energies) -> None:
    for i in range(4):
        for k in range(4):
            state.T_obj_cam[car, i, k] = candidate.T_obj_cam[car, i, k]
    for k in range(state.code.shape[1]):
        state.code[car, k] = candidate.code[car, k]
    for k in range(state.offset_px.shape[1]):
        state.offset_px[car, k] = candidate.offset_px[car, k]
    at.cost[car] = at_candidate.cost[car]
    for i in range(at.gradient.shape[1]):
        at.gradient[car, i] = at_candidate.gradient[car, i]
        for k in range(at.gradient.shape[1]):
            at.hessian[car, i, k] = at_candidate.hessian[car, i, k]
