"""Waits for the graphics card are counted from PyTorch's warnings; here somebody else warns."""

from __future__ import annotations

import warnings

import pytest
import torch

from directshape_torch.benchmark.synchronisations import count_synchronisations


@pytest.fixture
def modes(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Every mode that was set."""
    found: list[object] = []
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", found.append)
    return found


def test_each_warning_of_a_synchronisation_counts_also_from_the_same_line(modes: list[object]) -> None:
    def call() -> None:
        for _ in range(3):
            warnings.warn("called a synchronizing CUDA operation (Triggered internally)", UserWarning, stacklevel=1)
        warnings.warn("something else", UserWarning, stacklevel=1)

    count = count_synchronisations(call)

    assert count.total == 3
    assert len(count.by_place) == 1
    assert modes == ["warn", 0]


def test_the_mode_is_restored_after_an_error(modes: list[object]) -> None:
    def call() -> None:
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        count_synchronisations(call)

    assert modes == ["warn", 0]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_reading_a_value_is_one_synchronisation() -> None:
    x = torch.ones(1, device="cuda")

    assert count_synchronisations(x.item).total == 1
    assert count_synchronisations(lambda: x + 1).total == 0
