"""Constants: one copy a device and precision, right for training whoever asked first."""

from __future__ import annotations

import torch

from attentionvote.model.constants import Constant

META = torch.device("meta")


def test_a_table_is_copied_once_a_device_and_precision() -> None:
    constant = Constant(torch.tensor([0.1, 0.2], dtype=torch.float64))
    first = constant.on(META, torch.float32)
    assert (first.device, first.dtype) == (META, torch.float32)
    assert constant.like(torch.zeros(1, device=META)) is first
    assert constant.on(META, torch.float64) is not first
    assert torch.equal(constant.like(torch.zeros(())), torch.tensor([0.1, 0.2]))


def test_a_copy_that_a_validation_made_serves_a_training() -> None:
    constant = Constant(torch.tensor([2.0], dtype=torch.float64))
    weight = torch.ones(1, requires_grad=True)
    with torch.inference_mode():
        assert not constant.like(weight.detach()).is_inference()
    (constant.like(weight) * weight).sum().backward()
    assert weight.grad == 2.0


def test_a_graph_holds_the_numbers_themselves() -> None:
    class Shifted(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.shift = Constant(torch.tensor([1.0, 2.0]))

        def forward(self, values: torch.Tensor) -> torch.Tensor:
            return values + self.shift.like(values)

    module, values = Shifted(), torch.zeros(2)
    graph = torch.export.export(module, (values,), strict=False)
    assert torch.equal(graph.module()(values), torch.tensor([1.0, 2.0]))
    assert not module.shift._copies
