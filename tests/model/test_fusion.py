"""The attention over gathered votes against Eq. (4) written out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from attentionvote.model.fusion import AttentionVoting, VoteBranch


@pytest.fixture
def votes() -> tuple[Tensor, Tensor, Tensor]:
    """Offsets of 5 proposals' 4 votes, features of 12 votes, indices."""
    rng = np.random.default_rng(0)
    offsets, features = rng.normal(size=(5, 4, 3)), rng.normal(size=(12, 6))
    index = rng.integers(0, 12, (5, 4))
    return torch.from_numpy(offsets).float(), torch.from_numpy(features).float(), torch.from_numpy(index)


@pytest.fixture
def fusion() -> AttentionVoting:
    """With norms that are not the identity."""
    torch.manual_seed(0)
    module = AttentionVoting(6, [8, 10, 4]).eval()
    for norm in (m for m in module.modules() if isinstance(m, nn.BatchNorm1d)):
        nn.init.uniform_(norm.running_var, 0.5, 2.0)
        nn.init.normal_(norm.running_mean, std=0.3)
    return module


def by_hand(branch: VoteBranch, z: np.ndarray, g: np.ndarray) -> np.ndarray:
    """The branch as an MLP over the concatenation [z; g] of one vote."""
    first = torch.cat([branch.offset.weight, branch.project.weight], dim=1).detach().double().numpy()
    x = first @ np.concatenate([z, g])
    for layer in branch.rest:
        if isinstance(layer, nn.BatchNorm1d):
            mean, var, scale, bias = (
                t.detach().double().numpy() for t in (layer.running_mean, layer.running_var, layer.weight, layer.bias)
            )
            x = (x - mean) / np.sqrt(var + layer.eps) * scale + bias
        elif isinstance(layer, nn.ReLU):
            x = np.maximum(x, 0)
        else:
            bias = 0.0 if layer.bias is None else layer.bias.detach().double().numpy()
            x = layer.weight.detach().double().numpy() @ x + bias
    return x


def test_fusion_is_equation_4(fusion: AttentionVoting, votes: tuple[Tensor, Tensor, Tensor]) -> None:
    offsets, features, index = votes
    actual = fusion(*votes).detach().numpy()
    for k in range(5):
        z, g = offsets[k].double().numpy(), features[index[k]].double().numpy()
        f = np.array([by_hand(fusion.feature, *pair) for pair in zip(z, g, strict=True)])
        w = np.array([by_hand(fusion.weight, *pair) for pair in zip(z, g, strict=True)])
        np.testing.assert_allclose(actual[k], (np.exp(w) * f).sum(0) / np.exp(w).sum(0), rtol=1e-4, atol=1e-5)


def test_each_channel_has_its_own_weights_and_equal_ones_give_the_mean(
    fusion: AttentionVoting, votes: tuple[Tensor, Tensor, Tensor]
) -> None:
    last = fusion.weight.rest[-1]
    nn.init.zeros_(last.weight)
    torch.testing.assert_close(fusion(*votes), fusion.feature(*votes).mean(1))
    # A vote with a far larger weight in channel 2 decides that channel alone.
    last.weight.data[2] = 1000 * torch.randn(last.weight.shape[1], generator=torch.Generator().manual_seed(1))
    chosen = fusion.weight(*votes)[..., 2].argmax(1)
    fused = fusion(*votes)
    torch.testing.assert_close(fused[:, 2], fusion.feature(*votes)[torch.arange(5), chosen, 2], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(fused[:, 1], fusion.feature(*votes).mean(1)[:, 1])


def test_order_of_the_votes_and_whole_repetitions_do_not_matter(
    fusion: AttentionVoting, votes: tuple[Tensor, Tensor, Tensor]
) -> None:
    offsets, features, index = votes
    expected = fusion(*votes)
    turned = fusion(offsets.flip(1), features, index.flip(1))
    twice = fusion(torch.cat([offsets, offsets], 1), features, torch.cat([index, index], 1))
    torch.testing.assert_close(turned, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(twice, expected, rtol=1e-5, atol=1e-6)
