"""Rows shared out over threads: every row once, at once, and errors that come back."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch

from attentionvote.model import row_threads
from attentionvote.model.row_threads import in_threads, thread_count


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=["of torch", "own"])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Torch's OpenMP threads, or a pool where another runtime is loaded."""
    kind: str = request.param
    if kind == "own":
        monkeypatch.setattr(row_threads, "_openmp", lambda: None)
    elif row_threads._openmp() is None:
        pytest.skip("torch's OpenMP runtime is of another kind here")
    return kind


@pytest.mark.parametrize(
    ("rows", "least", "count"), [(0, 1, 1), (1, 1, 1), (2, 1, 2), (127, 64, 1), (128, 64, 2), (9, 1, 3)]
)
def test_a_share_is_worth_its_thread(rows: int, least: int, count: int) -> None:
    assert thread_count(rows, least) == count


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("rows", [0, 1, 2, 3, 100])
def test_every_row_has_one_share(rows: int) -> None:
    shares: list[tuple[int, int, int]] = []
    in_threads(rows, lambda *share: shares.append(share), least=1)
    assert [index for index, _, _ in sorted(shares)] == list(range(thread_count(rows, 1)))
    assert [row for _, start, stop in sorted(shares) for row in range(start, stop)] == list(range(rows))


@pytest.mark.usefixtures("threads")
def test_shares_run_at_the_same_time() -> None:
    all_here = threading.Barrier(3, timeout=20)
    in_threads(3, lambda *_: all_here.wait() and None, least=1)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("failing", [0, 2])
def test_an_error_in_a_share_is_raised_after_the_others_are_done(failing: int) -> None:
    done = []

    def work(index: int, *_: int) -> None:
        if index == failing:
            raise MemoryError(f"share {index}")
        done.append(index)

    with pytest.raises(MemoryError, match=f"share {failing}"):
        in_threads(3, work, least=1)
    assert sorted(done) == [index for index in range(3) if index != failing]


def test_torch_computes_as_before_afterwards() -> None:
    values = torch.randn(512, 256)
    expected = values.double() @ values.double().T
    for _ in range(20):
        in_threads(3, lambda *_: None, least=1)
        torch.testing.assert_close((values @ values.T).double(), expected, rtol=1e-3, atol=1e-3)
