"""Instances as bits: every pixel of every mask, from several stacks, found again."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.observation.mask_extents import mask_extents
from directshape_torch.observation.occlusion import instance_crops


@pytest.mark.parametrize("counts", [(3, 0, 2), (0, 0), (150, 100)])
def test_bits_give_back_the_masks(counts: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(sum(counts))
    stacks = [torch.rand(count, 9, 12, generator=generator) for count in counts]
    stacks[-1] = stacks[-1] > 0.8  # of another dtype
    total = sum(counts)
    frame = torch.randint(3, (total,), generator=generator)
    extents = mask_extents(stacks, [torch.ones(count, dtype=torch.bool) for count in counts])
    boxes = torch.cat([part.boxes for part in extents])
    if total > 2:
        boxes[1] = 0  # left out
    crops = instance_crops(stacks, boxes, frame, num_frames=3)
    masks = torch.cat([stack > 0.5 for stack in stacks])
    for number in range(total):
        u0, v0, u1, v1 = crops.boxes[frame[number]].tolist()
        start, area = int(crops.start[frame[number]]), (v1 - v0) * (u1 - u0)
        covering = crops.covering[start : start + area].view(v1 - v0, u1 - u0, -1)
        found = torch.zeros(9, 12, dtype=torch.bool)
        found[v0:v1, u0:u1] = ((covering & crops.bits[number]) != 0).any(dim=-1)
        assert torch.equal(found, masks[number] if boxes[number].any() else torch.zeros_like(found))


@pytest.mark.parametrize(("count", "words"), [(1, 1), (31, 1), (32, 4), (124, 4), (125, 8), (249, 16)])
def test_few_numbers_of_words_occur(count: int, words: int) -> None:
    """Each of them is compiled for by itself."""
    boxes = torch.tensor([[0, 0, 2, 1]]).expand(count, -1)
    crops = instance_crops([torch.ones(count, 1, 2)], boxes, torch.zeros(count, dtype=torch.long), num_frames=1)
    assert crops.bits.shape == (count, words)
    assert crops.covering.shape[1] == words


def test_frames_without_instances_take_no_memory() -> None:
    masks = torch.zeros(1, 5, 6)
    masks[0, 2, 3] = 1.0
    crops = instance_crops([masks], torch.tensor([[3, 2, 4, 3]]), torch.tensor([1]), num_frames=3)
    assert crops.boxes.tolist() == [[0, 0, 0, 0], [3, 2, 4, 3], [0, 0, 0, 0]]
    assert crops.covering.tolist() == [[1], [0], [0]]
