"""Errors of the package keep their words and fields on the way to another process."""

from __future__ import annotations

import pickle

import pytest

from directshape_torch import errors

RAISED = [
    errors.DirectShapeError("no frame is left"),
    errors.InputError("masks", "(B, H, W)", "(3,)", "stack them"),
    errors.DataFormatError("a.txt", "has no columns", line_number=3, line="1 2", cure="write it again"),
    errors.ConfigError("search: expected a word"),
    errors.MeshError("a.obj has no faces"),
    errors.UnlikelyMeshError("a.obj is 200 m long", {"unit": "cm"}),
    errors.ResumeError("cannot resume"),
    errors.CompilationError("no compiler"),
    errors.MissingDependencyError("ray", "cluster", "a run on a cluster"),
]


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_an_error_comes_back_from_another_process(error: errors.DirectShapeError) -> None:
    found = pickle.loads(pickle.dumps(error))
    assert type(found) is type(error)
    assert (str(found), found.args, vars(found)) == (str(error), error.args, vars(error))
    assert getattr(found, "msg", None) == getattr(error, "msg", None)


def test_each_error_of_the_module_is_tried() -> None:
    kinds = {x for x in vars(errors).values() if isinstance(x, type) and issubclass(x, errors.DirectShapeError)}
    assert kinds == {type(error) for error in RAISED}
