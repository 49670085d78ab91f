"""The three fusions of gathered votes against Eq. (4), and a PointNet, written out vote by vote."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from attentionvote.model.fusion import FUSIONS, AttentionVoting, MatrixAttention, PointNetPooling, VoteBranch


@pytest.fixture
def votes() -> tuple[Tensor, Tensor, Tensor]:
    """Offsets of 5 proposals' 4 votes, features of 12 votes, indices."""
    rng = np.random.default_rng(0)
    offsets, features = rng.normal(size=(5, 4, 3)), rng.normal(size=(12, 6))
    index = rng.integers(0, 12, (5, 4))
    return torch.from_numpy(offsets).float(), torch.from_numpy(features).float(), torch.from_numpy(index)


def with_norms(module: Any) -> Any:
    """In evaluation, with norms that are not the identity."""
    for norm in (m for m in module.eval().modules() if isinstance(m, nn.BatchNorm1d)):
        nn.init.uniform_(norm.running_var, 0.5, 2.0)
        nn.init.normal_(norm.running_mean, std=0.3)
    return module


@pytest.fixture
def fusion() -> AttentionVoting:
    torch.manual_seed(0)
    return with_norms(AttentionVoting(6, [8, 10, 4]))


@pytest.fixture(params=FUSIONS)
def any_fusion(request: pytest.FixtureRequest) -> Any:
    torch.manual_seed(0)
    return with_norms(FUSIONS[request.param](6, [8, 10, 4]))


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


def test_matrix_attention_is_equation_4_with_the_product_of_votes_and_matrix(
    votes: tuple[Tensor, Tensor, Tensor],
) -> None:
    torch.manual_seed(1)
    fusion = with_norms(MatrixAttention(6, [8, 10, 4]))
    offsets, features, index = votes
    blocks = [fusion.weight_of_offset.weight, fusion.weight_of_feature.weight]
    matrix = torch.cat(blocks, dim=1).detach().double().numpy().T  # W, (3 + F, width)
    assert matrix.shape == (9, 4)
    actual = fusion(*votes).detach().numpy()
    for k in range(5):
        z, g = offsets[k].double().numpy(), features[index[k]].double().numpy()
        f = np.array([by_hand(fusion.feature, *pair) for pair in zip(z, g, strict=True)])
        w = np.concatenate([z, g], axis=1) @ matrix
        np.testing.assert_allclose(actual[k], (np.exp(w) * f).sum(0) / np.exp(w).sum(0), rtol=1e-4, atol=1e-5)
    # A matrix of zeros weighs all votes alike.
    for block in blocks:
        nn.init.zeros_(block)
    torch.testing.assert_close(fusion(*votes), fusion.feature(*votes).mean(1))


def test_pointnet_pooling_is_the_largest_of_each_channel_after_relu(votes: tuple[Tensor, Tensor, Tensor]) -> None:
    torch.manual_seed(2)
    fusion = with_norms(PointNetPooling(6, [8, 10, 4]))
    offsets, features, index = votes
    actual = fusion(*votes).detach().numpy()
    for k in range(5):
        z, g = offsets[k].double().numpy(), features[index[k]].double().numpy()
        f = np.array([by_hand(fusion.feature, *pair) for pair in zip(z, g, strict=True)])
        np.testing.assert_allclose(actual[k], np.maximum(f, 0).max(0), rtol=1e-4, atol=1e-5)
    assert (actual > 0).any()


def test_golden_numbers_of_every_fusion() -> None:
    """Weights: a sine of their index and 0.4. Origin: printed by this test (``-s``); the references above judge it."""
    actual = {}
    for kind, module in FUSIONS.items():
        fusion = module(2, [3, 2]).eval()
        for i, p in enumerate(fusion.parameters()):
            p.data = 0.4 + torch.sin(0.7 * torch.arange(p.numel()) ** 2 + i).view(p.shape)
        z = torch.tensor([[[0.5, -0.25, 0.0], [-0.5, 1.0, 0.25]]])
        actual[kind] = fusion(z, torch.tensor([[1.0, -2.0], [0.5, 3.0]]), torch.tensor([[0, 1]]))[0].tolist()
    print(actual)
    for kind, expected in GOLDEN.items():
        np.testing.assert_allclose(actual[kind], expected, atol=1e-5, err_msg=kind)


GOLDEN = {"aml": [-1.39774, -0.00566], "amx": [-1.76467, -0.35064], "pn": [0.0, 0.11275]}


def test_order_of_the_votes_and_whole_repetitions_do_not_matter(
    any_fusion: Any, votes: tuple[Tensor, Tensor, Tensor]
) -> None:
    offsets, features, index = votes
    expected = any_fusion(*votes)
    turned = any_fusion(offsets.flip(1), features, index.flip(1))
    twice = any_fusion(torch.cat([offsets, offsets], 1), features, torch.cat([index, index], 1))
    torch.testing.assert_close(turned, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(twice, expected, rtol=1e-5, atol=1e-6)


def test_gradients_equal_finite_differences(any_fusion: Any, votes: tuple[Tensor, Tensor, Tensor]) -> None:
    offsets, features, index = votes
    module = any_fusion.double()
    inputs = offsets.double().requires_grad_(), features.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda z, g: module(z, g, index), inputs)
    last = next(reversed(list(module.parameters())))
    assert torch.autograd.gradcheck(
        lambda w: torch.func.functional_call(
            module, {name_of(module, last): w}, (offsets.double(), features.double(), index)
        ),
        last,
    )


def name_of(module: nn.Module, parameter: Tensor) -> str:
    return next(name for name, p in module.named_parameters() if p is parameter)
