import numpy as np
import pytest
import trimesh

from directshape_torch.errors import InputError
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.visualize.prior_pictures import prior_picture, shaded_view


def test_silhouette_of_a_box_has_its_size():
    # 3 x 1 m at 52 pixels per metre: 156 x 52 pixels, give or take the border.
    box = trimesh.creation.box((3.0, 1.0, 1.5)).apply_translation((0.0, -0.5, 0.0))
    image = shaded_view(np.asarray(box.vertices), np.asarray(box.faces), 0.0, 0.0)
    rows, columns = np.nonzero((image < 255).any(axis=2))
    assert np.ptp(columns) == pytest.approx(156, abs=2)
    assert np.ptp(rows) == pytest.approx(52, abs=2)


def test_the_front_is_to_the_right_and_near_faces_hide_far_ones():
    box = trimesh.creation.box((1.0, 0.5, 0.5)).apply_translation((1.0, -0.7, 0.0))
    image = shaded_view(np.asarray(box.vertices), np.asarray(box.faces), 0.0, 0.0)
    columns = np.nonzero((image < 255).any(axis=(0, 2)))[0]
    assert columns.min() > image.shape[1] / 2


def test_one_row_a_component():
    prior = PCAShapePrior.load_bundled()
    one, two = (prior_picture(prior.with_num_codes(k)) for k in (1, 2))
    assert one.dtype == np.uint8
    assert two.shape[0] - one.shape[0] == (one.shape[0] - 16) // 2
    with pytest.raises(InputError, match="faces"):
        shaded_view(np.zeros((3, 3)), np.zeros((0, 3), dtype=int), 0.0, 0.0)
