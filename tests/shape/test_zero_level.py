import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.shape.sdf_grid import zero_level_extents


def box_sdf(
    half: tuple[float, float, float], centre: tuple[float, float, float], count: int = 25, spacing: float = 0.1
):
    x = torch.arange(count, dtype=torch.float64) * spacing - 0.5 * spacing * (count - 1)
    nodes = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1)
    q = (nodes - torch.tensor(centre, dtype=torch.float64)).abs() - torch.tensor(half, dtype=torch.float64)
    return q.clamp_min(0).norm(dim=-1) + q.amax(dim=-1).clamp_max(0), x[0].expand(3), spacing


def test_extents_of_boxes_between_nodes():
    # A box's field is linear across its faces, so the crossing is exact: centre -+ half size.
    boxes = [((0.33, 0.52, 0.71), (0.02, -0.07, 0.01)), ((0.61, 0.25, 0.4), (-0.11, 0.0, 0.13))]
    values = torch.stack([box_sdf(*box)[0] for box in boxes])
    _, origin, spacing = box_sdf(*boxes[0])
    expected = torch.tensor(
        [[[-0.31, -0.59, -0.70], [0.35, 0.45, 0.72]], [[-0.72, -0.25, -0.27], [0.50, 0.25, 0.53]]], dtype=torch.float64
    )
    torch.testing.assert_close(zero_level_extents(values, origin, spacing), expected, atol=1e-12, rtol=0)


def test_gradient_is_that_of_the_moving_surface():
    # Raising the field by e moves a face with unit gradient inwards by e: d upper / d e = -1, d lower / d e = +1.
    values, origin, spacing = box_sdf((0.33, 0.52, 0.71), (0.02, -0.07, 0.01))
    raise_by = torch.zeros((), dtype=torch.float64, requires_grad=True)
    extents = zero_level_extents((values + raise_by)[None], origin, spacing)
    for corner, sign in ((0, 1.0), (1, -1.0)):
        (slope,) = torch.autograd.grad(extents[0, corner, 1], raise_by, retain_graph=True)
        assert slope.item() == pytest.approx(sign, abs=1e-9)


def test_no_crossing_gives_nan_and_leaves_the_others_alone():
    values, origin, spacing = box_sdf((0.33, 0.52, 0.71), (0.0, 0.0, 0.0))
    both = zero_level_extents(torch.stack([values.abs() + 1, values]), origin, spacing)
    assert both[0].isnan().all()
    torch.testing.assert_close(both[1], zero_level_extents(values[None], origin, spacing)[0])


def test_no_objects_and_wrong_shape():
    assert zero_level_extents(torch.zeros(0, 4, 4, 4), torch.zeros(3), 0.1).shape == (0, 2, 3)
    with pytest.raises(InputError, match="values: expected shape"):
        zero_level_extents(torch.zeros(4, 4, 4), torch.zeros(3), 0.1)
