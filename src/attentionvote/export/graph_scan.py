"""Rows in blocks, one block after the other: the exported graph's ``Scan``.

``torch``'s own ``scan`` finds what its function closes over by compiling that function with dynamo, which takes 40 % of
an export. Here whoever calls says what it needs; the graph is the same but for the numbers in its names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._higher_order_ops.scan import scan_op
from torch.utils import _pytree as pytree


def in_blocks(
    step: Callable[[Sequence[Tensor], Any], Sequence[Tensor]], blocks: Sequence[Tensor], shared: Any
) -> list[Tensor]:
    """Call a step for every block and stack what it answers.

    Args:
        step: given a block of each of ``blocks`` and ``shared``. It must not use another tensor from outside, and what
            it answers must be no view of what it was given.
        blocks: tensors ``(steps, ...)``.
        shared: tensors that every step reads, in lists, tuples and dictionaries.
    """
    leaves, structure = pytree.tree_flatten(shared)

    def body(carry: Tensor, *inputs: Tensor) -> list[Tensor]:
        answers = step(inputs[: len(blocks)], pytree.tree_unflatten(inputs[len(blocks) :], structure))
        return [carry.clone(), *answers]  # a scan must carry something

    _, *rows = scan_op(body, [torch.zeros(1)], list(blocks), additional_inputs=tuple(leaves))
    return rows
