"""Mutants are what they claim, their tests exist, and a survivor is reported; a sample is run."""

from __future__ import annotations

import importlib
from pathlib import Path

import mutate_jacobians
import pytest
from jacobian_mutants.mutants import Mutant, mutants_of
from jacobian_mutants.runner import Outcome, UnmutatedFailureError, function_of, run_mutants
from jacobian_mutants.targets import EQUIVALENTS, TARGETS, Target, reason_for

_ROOT = Path(__file__).resolve().parents[2]


def changes(body: str) -> set[tuple[str, str, str]]:
    source = f"def f(a, b, x, J):\n    {body}\n".encode()
    made = mutants_of("f.py", source, ("f",))
    for mutant in made:
        compile(mutant.apply(source), "f.py", "exec")
    return {(m.kind, m.before, m.after) for m in made}


MADE = {
    "return a - b": {
        ("sign flip", "a - b", "(-(a - b))"),
        ("sign flip", "a - b", "(a + b)"),
        ("dropped term", "a - b", "(a)"),
        ("dropped term", "a - b", "(-b)"),
    },
    "return 1 / b": {("sign flip", "1 / b", "(-(1 / b))"), ("dropped factor", "1 / b", "(1)")},
    "return a.mT": {("swapped axes", "a.mT", "(a)")},
    "return bmm(a, b)": {("swapped arguments", "bmm(a, b)", "(bmm(b, a))")},
    "J[0] = torch.zeros_like(a)": {("swapped components", "J[0]", "J[1]")},
    # What is no arithmetic of a Jacobian stays.
    "return bmm(a, a)": set(),
    "return x.new_zeros(len(a), 6 + b)": set(),
    "return x.sum(-1)": set(),
    "raise ValueError(a - b)": set(),
}
AMONG_THOSE_MADE = [
    ("return a * b", ("dropped factor", "a * b", "(b)")),
    ("return a ** 2", ("dropped factor", "a ** 2", "(a)")),
    ("return a @ b", ("swapped axes", "a @ b", "(a.mT @ b)")),
    ("return a.transpose(1, 2)", ("swapped axes", "a.transpose(1, 2)", "(a)")),
    ("return x[..., 1]", ("swapped components", "x[..., 1]", "x[..., 0]")),
    ("return x[..., 0]", ("swapped components", "x[..., 0]", "x[..., 1]")),
    ("return x[:, :3]", ("swapped components", "x[:, :3]", "x[:, 3:6]")),
    ("return x[:, 3:6]", ("swapped components", "x[:, 3:6]", "x[:, 0:3]")),
    ("J[0, 4] = a", ("swapped components", "J[0, 4]", "J[0, 3]")),
    ("J[0, 4] = a", ("sign flip", "a", "(-a)")),
    ("return stack([a, b])", ("swapped components", "[a, b]", "[b, a]")),
    ("a, b = x.unbind(-1)", ("swapped components", "(a, b)", "(b, a)")),
    ("return cross(a, b)", ("swapped arguments", "cross(a, b)", "(cross(b, a))")),
    ("return Result(a)", ("sign flip", "a", "(-a)")),
]


def test_mutants_are_those_of_a_jacobians_arithmetic() -> None:
    for body, made in MADE.items():
        assert changes(body) == made, body
    for body, change in AMONG_THOSE_MADE:
        assert change in changes(body), body


@pytest.mark.parametrize("name", TARGETS)
def test_named_functions_and_tests_exist(name: str) -> None:
    target = TARGETS[name]
    assert mutants_of(target.path, (_ROOT / target.path).read_bytes(), target.functions)
    module = importlib.import_module(target.path.removesuffix(".py").replace("/", "."))
    for function in target.functions:
        assert function_of(module, function).__qualname__ == function
    for test in target.tests:
        path, _, function = test.partition("::")
        assert f"def {function.partition('[')[0]}" in (_ROOT / path).read_text(encoding="utf-8")


def test_every_exclusion_is_of_a_mutant_that_is_made() -> None:
    """An exclusion whose code has changed would hide a mutant of the new code."""
    made = [mutant for _, mutant in mutate_jacobians.all_mutants(_ROOT, TARGETS)]
    for equivalent in EQUIVALENTS:
        assert any(equivalent.matches(mutant) for mutant in made), equivalent
        assert len(equivalent.reason) > 20
    assert sum(reason_for(mutant) is not None for mutant in made) < 0.05 * len(made)


@pytest.fixture
def small_tree(tmp_path: Path) -> tuple[Path, Target]:
    """A module whose tests check its product but not its sum."""
    (tmp_path / "small_module_for_mutants.py").write_text(
        "def f(a, b):\n    return a * b\n\n\ndef g(a):\n    return a + 0\n"
    )
    (tmp_path / "test_small.py").write_text(
        "from small_module_for_mutants import f, g\n\n"
        "def test_f():\n    assert f(2, 3) == 6\n\ndef test_g():\n    assert g(0) == 0\n"
    )
    return tmp_path, Target("small_module_for_mutants.py", ("f", "g"), ("test_small.py",))


def _run(root: Path, target: Target) -> tuple[list[Outcome], list[Mutant]]:
    mutants = mutants_of(target.path, (root / target.path).read_bytes(), target.functions)
    seen: list[Mutant] = []
    outcomes = run_mutants(root, [("t", m) for m in mutants], {"t": target.tests}, 1, lambda o: seen.append(o.mutant))
    return outcomes, seen


def test_verdicts_of_a_small_tree(small_tree: tuple[Path, Target]) -> None:
    root, target = small_tree
    before = (root / target.path).read_bytes()
    outcomes, seen = _run(root, target)
    assert [o.mutant for o in outcomes] == seen
    of_f = [o for o in outcomes if o.mutant.function == "f"]
    assert {o.verdict for o in of_f} == {"caught"}
    assert {o.caught_by for o in of_f} == {"test_small.py::test_f"}
    assert of_f[0].error.startswith("assert")
    assert {o.verdict for o in outcomes if o.mutant.function == "g"} == {"survived"}
    assert (root / target.path).read_bytes() == before


def test_tests_that_fail_without_a_mutation_are_an_error(small_tree: tuple[Path, Target]) -> None:
    root, target = small_tree
    (root / "test_small.py").write_text("def test_nothing():\n    raise AssertionError('broken')\n")
    with pytest.raises(UnmutatedFailureError, match=r"t: test_small\.py::test_nothing without a mutation"):
        _run(root, target)
    (root / "test_small.py").write_text("import a_module_that_is_not_there\n")
    with pytest.raises(UnmutatedFailureError, match="cannot be imported"):
        _run(root, target)


def test_a_survivor_ends_the_command_with_1(
    small_tree: tuple[Path, Target], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root, target = small_tree
    monkeypatch.setattr(mutate_jacobians, "ROOT", root)
    monkeypatch.setattr(mutate_jacobians, "TARGETS", {"t": target})
    assert mutate_jacobians.main(["--processes", "1"]) == 1
    assert capsys.readouterr().out.count("SURVIVED") == 4


@pytest.mark.parametrize("words", [
    # The tests of this target are quick.
    ["--target", "projection", "--sample", "2"],
    pytest.param(["--sample", "60"], marks=pytest.mark.long),
], ids=["few", "many"])  # fmt: skip
def test_a_sample_of_the_real_mutants_is_caught(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert mutate_jacobians.main([*words, "--seed", "7", "--processes", "1"]) == 0
    assert f"{words[-1]} mutants: {words[-1]} caught" in capsys.readouterr().out
