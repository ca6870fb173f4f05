"""The picture shows the sign of the bias."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.visualize.rig_picture import draw_disparity_field

SIZE = (200, 80)
TITLE_PX = 34


@pytest.mark.parametrize(("value_px", "strong", "weak"), [(-0.4, 2, 0), (0.4, 0, 2)])
def test_negative_is_blue_and_positive_red(value_px: float, strong: int, weak: int) -> None:
    field = DisparityField.constant(value_px, SIZE, torch.eye(3), torch.eye(3), torch.eye(4))
    picture = draw_disparity_field(field, torch.tensor([[100.0, 40.0]]), torch.tensor([value_px]))
    assert picture.shape == (3 * (SIZE[1] + TITLE_PX), SIZE[0], 3)
    field_pixel = picture[TITLE_PX + 40, 100].astype(int)
    before = picture[(TITLE_PX + SIZE[1]) + TITLE_PX + 40, 100].astype(int)
    after = picture[2 * (TITLE_PX + SIZE[1]) + TITLE_PX + 40, 100].astype(int)
    assert field_pixel[strong] > field_pixel[weak] + 80
    assert before[strong] > before[weak] + 80
    assert after.min() > 240


def test_no_data_is_drawn_as_such() -> None:
    field = DisparityField.constant(0.1, SIZE, torch.eye(3), torch.eye(3), torch.eye(4))
    assert draw_disparity_field(field, torch.zeros(0, 2), torch.zeros(0)).dtype == "uint8"
