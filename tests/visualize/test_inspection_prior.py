"""The data behind the figures of a prior: fits of known cars, colours, sections, the path of the codes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from directshape_torch.errors import InputError
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_quality import grid_of
from directshape_torch.visualize.inspection.prior_figures import code_frames, code_path
from directshape_torch.visualize.inspection.shape_figure import (
    FRONT_VIEW,
    coloured_surface,
    distance_at,
    section,
    shaded_view,
    surface_colours,
)

PAINT = np.array([60.0, 130.0, 205.0])


@pytest.fixture(scope="module")
def prior() -> PCAShapePrior:
    return PCAShapePrior.load_bundled()


def test_colours_tell_outside_from_inside_and_zero_is_pale() -> None:
    outside, zero, inside = surface_colours(np.array([0.2, 0.0, -0.2]), 0.2)
    assert outside[0] > outside[2] + 50
    assert inside[2] > inside[0] + 50
    assert zero.min() > 235


def test_a_shape_has_no_distance_to_itself(prior: PCAShapePrior) -> None:
    picture = coloured_surface(prior, prior.mean, prior.mean, FRONT_VIEW, 0.25).astype(int)
    painted = picture[(picture < 250).any(axis=2)]
    assert len(painted) > 5000
    # All grey: shades of one pale colour.
    assert (painted.max(axis=1) - painted.min(axis=1)).max() < 12


def test_distances_are_the_nodes_values(prior: PCAShapePrior) -> None:
    nodes = grid_of(prior).nodes()[3:6, 4, 5]
    np.testing.assert_allclose(distance_at(prior, prior.mean, nodes), prior.mean[3:6, 4, 5], atol=1e-6)


def test_section_is_the_plane_of_symmetry(prior: PCAShapePrior) -> None:
    plane, (x0, x1, y0, y1) = section(prior, prior.mean)
    low, high = prior.bounds_obj.tolist()
    np.testing.assert_allclose([x0, x1, y0, y1], [low[0], high[0], low[1], high[1]], atol=1e-5)
    nodes = grid_of(prior).nodes()[:, :, 0].copy()
    nodes[..., 2] = 0
    np.testing.assert_allclose(plane.ravel(), distance_at(prior, prior.mean, nodes.reshape(-1, 3)), atol=1e-6)


def test_animation_has_a_frame_a_code_and_moves(prior: PCAShapePrior) -> None:
    codes = code_path(prior.num_codes, steps_a_code=4)
    assert codes.shape == (4 * prior.num_codes, prior.num_codes)
    still, moved, still_again = code_frames(prior, codes[[0, 1, 0]])
    assert still.shape == moved.shape
    assert (still != moved).any(axis=2).mean() > 0.02
    assert np.array_equal(still, still_again)


def test_silhouette_of_a_box_has_its_size() -> None:
    # 3 x 1 m at 52 pixels per metre: 156 x 52 pixels, give or take the border.
    box = trimesh.creation.box((3.0, 1.0, 1.5)).apply_translation((0.0, -0.5, 0.0))
    image = shaded_view(np.asarray(box.vertices), np.asarray(box.faces), 0.0, 0.0, PAINT)
    rows, columns = np.nonzero((image < 255).any(axis=2))
    assert np.ptp(columns) == pytest.approx(156, abs=2)
    assert np.ptp(rows) == pytest.approx(52, abs=2)


def test_the_front_is_to_the_right_and_a_shape_has_faces() -> None:
    box = trimesh.creation.box((1.0, 0.5, 0.5)).apply_translation((1.0, -0.7, 0.0))
    image = shaded_view(np.asarray(box.vertices), np.asarray(box.faces), 0.0, 0.0, PAINT)
    columns = np.nonzero((image < 255).any(axis=(0, 2)))[0]
    assert columns.min() > image.shape[1] / 2
    with pytest.raises(InputError, match="faces"):
        shaded_view(np.zeros((3, 3)), np.zeros((0, 3), dtype=int), 0.0, 0.0, PAINT)
