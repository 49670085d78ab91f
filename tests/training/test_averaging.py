"""The moving average of the weights: on a CPU Lightning's to the last bit, elsewhere in a few operations."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from attentionvote.training import averaging
from attentionvote.training.averaging import MovingAverage


class Module(L.LightningModule):
    """Weights and buffers of two kinds."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(3, 3) for _ in range(8)])
        self.norm = nn.BatchNorm1d(3)

    def step(self, seed: int) -> None:
        """Other values."""
        generator = torch.Generator().manual_seed(seed)
        for tensor in (*self.parameters(), *self.buffers()):
            if tensor.is_floating_point():
                tensor.data.copy_(torch.randn(tensor.shape, generator=generator))
            else:
                tensor += 1


def averaged(average: EMAWeightAveraging, steps: int = 5) -> dict[str, Tensor]:
    """The average after some steps of training."""
    module = Module()
    module.step(0)
    average.setup(SimpleNamespace(), module, "fit")  # type: ignore[arg-type]
    for step in range(1, steps + 1):
        module.step(step)
        average.on_train_batch_end(SimpleNamespace(global_step=step), module, None, None, step)  # type: ignore[arg-type]
    assert average._average_model is not None
    return dict(average._average_model.state_dict())


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Averages as on a GPU, where there is none."""
    monkeypatch.setattr(averaging, "averages_in_groups", lambda _: True)


def test_on_a_cpu_it_is_lightnings_and_so_are_its_checkpoints() -> None:
    theirs, ours = EMAWeightAveraging(decay=0.9, use_buffers=True), MovingAverage(0.9)
    assert ours.state_key == theirs.state_key
    expected, actual = averaged(theirs), averaged(ours)
    assert list(actual) == list(expected)
    assert all(torch.equal(value, expected[name]) for name, value in actual.items())
    assert ours.state_dict() == theirs.state_dict() == {"latest_update_step": 5}


@pytest.mark.usefixtures("elsewhere")
def test_on_another_device_it_is_the_same_average() -> None:
    ours = averaged(MovingAverage(0.9))
    assert ours["n_averaged"] == 5
    expected = averaged(EMAWeightAveraging(decay=0.9, use_buffers=True))
    for name, value in ours.items():
        torch.testing.assert_close(value, expected[name], rtol=1e-6, atol=1e-6)


class Operations(TorchDispatchMode):
    """Counts operations."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        del types
        if "detach" not in str(func):
            self.count += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.usefixtures("elsewhere")
def test_on_another_device_a_step_is_a_few_operations() -> None:
    module, average = Module(), MovingAverage(0.9)
    average.setup(SimpleNamespace(), module, "fit")  # type: ignore[arg-type]
    for step in (1, 2):
        with Operations() as operations:
            average.on_train_batch_end(SimpleNamespace(global_step=step), module, None, None, 0)  # type: ignore[arg-type]
    assert operations.count < 15 < len(list(module.parameters()))


def test_the_form_follows_the_device() -> None:
    assert not averaging.averages_in_groups(torch.device("cpu"))
    assert averaging.averages_in_groups(torch.device("cuda", 0))
