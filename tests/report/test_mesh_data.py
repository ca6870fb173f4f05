"""Meshes as text: whole millimetres there and back."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.report.page_data import mesh_data, packed, unpacked
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.visualize.drawn_car import decoded_car


@settings(max_examples=50)
@given(st.lists(st.integers(-(2**30), 2**30 - 1)))
def test_numbers_come_back(numbers: list[int]) -> None:
    assert unpacked(packed(np.array(numbers, dtype=np.int64))).tolist() == numbers


def test_a_triangle_by_hand() -> None:
    data = mesh_data(np.array([[0.0, 0.1, -2.0], [1.2344, 0.0, 0.0], [1.2346, -0.5, 3.0]]), np.array([[2, 0, 1]]))
    # x of all vertices, then y, then z, in millimetres.
    assert unpacked(data["vertices"]).tolist() == [0, 1234, 1235, 100, 0, -500, -2000, 0, 3000]
    assert unpacked(data["faces"]).tolist() == [2, 0, 1]


def test_a_car_is_small() -> None:
    prior = PCAShapePrior.load_bundled()
    mesh = decoded_car(prior, np.zeros(prior.num_codes))
    data = mesh_data(mesh.vertices, mesh.faces)
    assert np.abs(unpacked(data["vertices"]).reshape(3, -1).T / 1000 - mesh.vertices).max() <= 0.0005 + 1e-9
    assert len(data["vertices"]) + len(data["faces"]) < 25_000
