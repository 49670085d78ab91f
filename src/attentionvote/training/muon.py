"""Muon: steps of one length in all directions of a weight matrix, for training in fewer steps.

Adam scales every weight by itself; a matrix's gradient is then still dominated by a few directions, and the others
learn late. Muon (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks") takes the momentum of a
matrix and replaces it by the nearest matrix with orthogonal rows or columns, found by a Newton-Schulz iteration; the
step is scaled to the size that Adam's has (Liu et al. 2025, "Muon is scalable for LLM training", section 2.2). Unlike
``torch.optim.Muon`` this one takes the other weights too, works in their precision (that one needs a processor with
bfloat16 to be fast) and iterates all matrices of one shape together.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim import Optimizer

ITERATIONS = 5
LEAST_WIDTH = 16  # narrower matrices read coordinates or write poses: nothing to orthogonalise
_QUINTIC = (3.4445, -4.7750, 2.0315)  # Jordan's: singular values end within .7 and 1.2 in five iterations
_ADAM_SIZE = 0.2  # root mean square of Adam's update
_ADAM_SHARE = 0.3  # of the learning rate: what orthogonal steps bear is too much for Adam's


def orthogonalized(matrices: Float[Tensor, "count rows columns"]) -> Float[Tensor, "count rows columns"]:
    """The nearest matrices whose rows (columns, where there are fewer) are nearly orthonormal; zero stays zero."""
    wide = matrices if matrices.shape[-2] <= matrices.shape[-1] else matrices.mT
    a, b, c = _QUINTIC
    x = wide / wide.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-12)
    for _ in range(ITERATIONS):
        # [n, r, c] @ [n, c, r] -> [n, r, r]
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x if wide is matrices else x.mT


class Muon(Optimizer):
    """Muon for matrices, AdamW for everything else.

    Args:
        weights: all weights; those with fewer than two dimensions do not decay.
        lr: learning rate of the matrices; of the others 0.3 times as much.
        weight_decay: decoupled, of weights with two dimensions.
        momentum: of the matrices, Nesterov's.
        betas: of AdamW.
        eps: of AdamW.
    """

    def __init__(
        self,
        weights: Iterable[Tensor],
        lr: float = 1e-2,
        weight_decay: float = 0.0,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.95),
        eps: float = 1e-8,
    ) -> None:
        matrices: list[Tensor] = []
        narrow: list[Tensor] = []
        plain: list[Tensor] = []
        for weight in weights:
            is_matrix = weight.ndim == 2 and min(weight.shape) >= LEAST_WIDTH
            (matrices if is_matrix else narrow if weight.ndim > 1 else plain).append(weight)
        groups = [
            {"params": matrices, "orthogonal": True, "weight_decay": weight_decay},
            {"params": narrow, "orthogonal": False, "weight_decay": weight_decay, "lr": _ADAM_SHARE * lr},
            {"params": plain, "orthogonal": False, "weight_decay": 0.0, "lr": _ADAM_SHARE * lr},
        ]
        defaults = {"lr": lr, "momentum": momentum, "betas": betas, "eps": eps, "steps": 0}
        super().__init__([group for group in groups if group["params"]], defaults)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step; returns what ``closure`` returns, which computes the gradients where it is given."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            group["steps"] += 1
            weights = [w for w in group["params"] if w.grad is not None]
            if not weights:
                continue
            torch._foreach_mul_(weights, 1.0 - group["lr"] * group["weight_decay"])
            if group["orthogonal"]:
                self._orthogonal_step(group, weights)
            else:
                self._adam_step(group, weights)
        return loss

    def _orthogonal_step(self, group: dict[str, Any], weights: list[Tensor]) -> None:
        gradients: list[Tensor] = [w.grad for w in weights]  # type: ignore[misc]
        velocities = self._state("velocity", weights)
        torch._foreach_mul_(velocities, group["momentum"])
        torch._foreach_add_(velocities, gradients)
        ahead = torch._foreach_add(gradients, velocities, alpha=group["momentum"])
        of_shape: defaultdict[tuple[int, ...], list[int]] = defaultdict(list)
        for i, weight in enumerate(weights):
            of_shape[tuple(weight.shape)].append(i)
        for shape, indices in of_shape.items():
            size = group["lr"] * _ADAM_SIZE * max(shape) ** 0.5
            updates = orthogonalized(torch.stack([ahead[i] for i in indices]))
            torch._foreach_add_([weights[i] for i in indices], list(updates), alpha=-size)

    def _adam_step(self, group: dict[str, Any], weights: list[Tensor]) -> None:
        gradients: list[Tensor] = [w.grad for w in weights]  # type: ignore[misc]
        (first, second), steps = group["betas"], group["steps"]
        means, squares = self._state("mean", weights), self._state("square", weights)
        torch._foreach_lerp_(means, gradients, 1.0 - first)
        torch._foreach_mul_(squares, second)
        torch._foreach_addcmul_(squares, gradients, gradients, 1.0 - second)
        spread = torch._foreach_sqrt(squares)
        torch._foreach_div_(spread, (1.0 - second**steps) ** 0.5)
        torch._foreach_add_(spread, group["eps"])
        torch._foreach_addcdiv_(weights, means, spread, -group["lr"] / (1.0 - first**steps))

    def _state(self, name: str, weights: list[Tensor]) -> list[Tensor]:
        """A quantity of every weight, zero at the beginning."""
        for weight in weights:
            if name not in self.state[weight]:
                self.state[weight][name] = torch.zeros_like(weight)
        return [self.state[weight][name] for weight in weights]
