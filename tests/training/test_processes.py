"""What processes tell each other: everything once, in the order of their ranks, whatever one of them has to do."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

from attentionvote.training import processes
from attentionvote.training.processes import FirstDoes, is_echo

InProcesses = Callable[[int, Callable[..., Any]], list[Any]]


def test_three_processes_tell_each_other_everything(in_processes: InProcesses) -> None:
    def talk(rank: int, first_does: FirstDoes) -> dict[str, Any]:
        start = time.monotonic()
        slow = first_does("slow", lambda: time.sleep(0.5) or {"answer": rank + 7})
        return {
            "me": (processes.rank(), processes.count()),
            "slow": slow,
            "waited": time.monotonic() - start,
            "sum": processes.summed(torch.tensor([1.0, 10.0 * rank])).tolist(),
            "all": processes.everyones(torch.tensor([rank, rank * rank])).tolist(),
            "gathered": processes.in_order([f"{rank}{i}" for i in range(3 - rank)]),
            "first": processes.from_first(f"said by {rank}"),
        }

    told = in_processes(3, talk)
    assert [t["me"] for t in told] == [(0, 3), (1, 3), (2, 3)]
    assert [t["slow"] for t in told] == [{"answer": 7}] * 3  # the first one's, in all
    assert min(t["waited"] for t in told) >= 0.4
    assert [t["sum"] for t in told] == [[3.0, 30.0]] * 3
    assert [t["all"] for t in told] == [[[0, 0], [1, 1], [2, 4]]] * 3
    assert [t["gathered"] for t in told] == [["00", "01", "02", "10", "11", "20"], [], []]
    assert [t["first"] for t in told] == ["said by 0"] * 3


def test_a_process_of_its_own_talks_to_itself() -> None:
    values = torch.tensor([1.0, 2.0], requires_grad=True)
    assert (processes.rank(), processes.count()) == (0, 1)
    assert not processes.summed(values).requires_grad
    assert torch.equal(processes.everyones(values), torch.tensor([[1.0, 2.0]]))
    assert processes.in_order((3, 4)) == [3, 4]
    assert processes.from_first("x") == "x"


def test_the_end_of_another_process_is_told_from_an_error_of_its_own(in_processes: InProcesses) -> None:
    def fail(rank: int) -> None:
        if rank:
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            processes.summed(torch.zeros(1))
        except RuntimeError as error:
            raise AssertionError(f"echo: {is_echo(error)}") from error

    with pytest.raises(AssertionError, match="echo: True"):
        in_processes(2, fail)
    assert not is_echo(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))
    assert not is_echo(ValueError("cloud 3 is damaged"))
