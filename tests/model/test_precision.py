"""Mixed precision leaves positions and rotations alone."""

from __future__ import annotations

import pytest
import torch

from attentionvote.model.precision import full_precision, widened
from attentionvote.model.proposals import heatmap_peaks, heatmap_reference

CPU = torch.device("cpu")


def test_products_keep_their_precision_inside_autocast() -> None:
    a, b = torch.rand(8, 8), torch.rand(8, 8)
    with torch.autocast("cpu", torch.bfloat16):
        assert (a @ b).dtype == torch.bfloat16
        with full_precision(CPU):
            product = a @ b
    torch.testing.assert_close(product, a @ b, rtol=0, atol=0)


def test_without_autocast_nothing_changes() -> None:
    with full_precision(CPU):
        assert (torch.rand(2, 2).bfloat16() @ torch.rand(2, 2).bfloat16()).dtype == torch.bfloat16
        assert not torch.is_autocast_enabled("cpu")


@pytest.mark.parametrize(
    ("given", "expected"),
    [(torch.bfloat16, torch.float32), (torch.float32, torch.float32), (torch.float64, torch.float64)],
    ids=str,
)
def test_widened_is_at_least_float32(given: torch.dtype, expected: torch.dtype) -> None:
    assert widened(torch.zeros(2, dtype=given)).dtype == expected


def test_center_seeds_are_the_same_under_autocast(monkeypatch: pytest.MonkeyPatch) -> None:
    # As on a GPU, where the reference does the work: 0.8 m away a step of bfloat16 is 4 mm.
    monkeypatch.setattr("attentionvote.model.proposals.native.load", lambda *_, **__: None)
    generator = torch.Generator().manual_seed(0)
    center = torch.tensor([[0.0, 0.0, 0.8], [0.1, 0.05, 0.75]])
    votes = (center.repeat(32, 1) + 0.003 * torch.randn(64, 3, generator=generator))[None]
    exact = heatmap_peaks(votes, 0.005, 8)
    with torch.autocast("cpu", torch.bfloat16):
        assert (
            heatmap_reference(votes, 0.005, 1)[2] - heatmap_reference(votes.double(), 0.005, 1)[2]
        ).abs().max() > 5e-4
        mixed = heatmap_peaks(votes, 0.005, 8)
    torch.testing.assert_close(mixed.center_seed, exact.center_seed, rtol=0, atol=0)
    torch.testing.assert_close(mixed.heat, exact.heat, rtol=0, atol=0)
