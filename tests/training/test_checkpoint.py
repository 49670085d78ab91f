"""Checkpoints are whole or not there, say what they are, and give the network back without a configuration."""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_network import BRICK_CHANGES, TINY_ARGUMENTS, tiny_network

from attentionvote.model.network import AttentionVote
from attentionvote.training.checkpoint import (
    FORMAT,
    KEY,
    load_trained,
    save_trained,
    usable_checkpoint,
    write_atomically,
)
from attentionvote.training.checkpoint_writer import AtomicCheckpoints

METADATA: dict[str, Any] = {
    "format": FORMAT,
    "version": "0.1.0",
    "model": TINY_ARGUMENTS | BRICK_CHANGES,
    "part": {"name": "brick", "diameter": 0.075, "digest": "abc", "symmetry": {"kind": "none"}},
    "points": 128,
    "confidence_threshold": 0.35,
}


@pytest.fixture
def model() -> AttentionVote:
    return tiny_network(1, **BRICK_CHANGES).eval()


@pytest.fixture
def path(tmp_path: Path, model: AttentionVote) -> Path:
    save_trained(model, METADATA, tmp_path / "model.ckpt")
    return tmp_path / "model.ckpt"


def test_a_trained_network_comes_back_the_same(path: Path, model: AttentionVote) -> None:
    again, metadata = load_trained(path)
    assert metadata == METADATA
    assert not again.training
    points = torch.rand(2, 128, 3, generator=torch.Generator().manual_seed(0)) * 0.1 + torch.tensor([0.0, 0.0, 0.5])
    normals = torch.nn.functional.normalize(-points, dim=-1)
    with torch.no_grad():
        for a, b in zip(model(points, normals), again(points, normals), strict=True):
            assert torch.equal(a, b)


def test_a_checkpoint_of_lightning_s_is_read_as_well(tmp_path: Path, model: AttentionVote) -> None:
    weights = {f"model.{k}": v for k, v in model.state_dict().items()}
    content = {KEY: METADATA, "state_dict": weights, "epoch": 3, "optimizer_states": [{"step": 2}]}
    AtomicCheckpoints().save_checkpoint(content, tmp_path / "new" / "last.ckpt")
    called = []
    AtomicCheckpoints(lambda: called.append((tmp_path / "new" / "other.ckpt").exists())).save_checkpoint(
        content, tmp_path / "new" / "other.ckpt"
    )
    assert called == [False]
    (tmp_path / "new" / "other.ckpt").unlink()
    again, _ = load_trained(str(tmp_path / "new" / "last.ckpt"))
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True))
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["last.ckpt"]


def without(*names: str) -> dict[str, Any]:
    return {k: v for k, v in METADATA.items() if k not in names}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"state_dict": {}}, "must be one of attentionvote's, but it has no 'attentionvote' entry"),
        ([1, 2], "must be one of attentionvote's"),
        ({KEY: METADATA | {"format": 99}, "state_dict": {}}, "must have format 1, got 99: .* attentionvote 0.1.0"),
        ({KEY: METADATA, "state_dict": {}}, "does not fit this version's network: Error"),
        ({KEY: METADATA | {"model": {"x": 1}}, "state_dict": {}}, "does not fit this version's network: .*'diameter'"),
        ({KEY: without("model"), "state_dict": {}}, "does not fit this version's network: 'model'"),
    ],
)
def test_files_of_others_are_named(tmp_path: Path, content: Any, message: str) -> None:
    torch.save(content, tmp_path / "other.ckpt")
    with pytest.raises(ValueError, match=message):
        load_trained(tmp_path / "other.ckpt")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_torn_files_are_named(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(ValueError, match=r"model.ckpt cannot be read .*torn or no checkpoint"):
        load_trained(path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"checkpoint .*none.ckpt must exist: train one with `make train`"):
        load_trained(tmp_path / "none.ckpt")


def test_nothing_but_plain_values_is_unpickled(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "harm"),)

    torch.save({KEY: METADATA, "state_dict": Evil()}, tmp_path / "evil.ckpt")
    with pytest.raises(ValueError, match="cannot be read"):
        load_trained(tmp_path / "evil.ckpt")
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_the_older_checkpoint(path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    before = path.read_bytes()

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(*{"fsync": (os, "fsync"), "replace": (Path, "replace")}[step], full)
    with pytest.raises(OSError, match=r"model.ckpt cannot be written \(No space left on device\); the one before it"):
        write_atomically({"a": 1}, path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["model.ckpt"]


def test_the_first_checkpoint_that_can_be_used_is_chosen(
    tmp_path: Path, model: AttentionVote, caplog: pytest.LogCaptureFixture
) -> None:
    last, best = tmp_path / "last.ckpt", tmp_path / "best.ckpt"
    shapes = {f"model.{k}": v.shape for k, v in model.state_dict().items()}
    assert usable_checkpoint([last, best], shapes) is None
    save_trained(model, METADATA, best)
    assert usable_checkpoint([last, best], shapes) == best
    save_trained(model, METADATA, last)
    assert usable_checkpoint([last, best], shapes) == last
    assert not caplog.records
    leftovers = [tmp_path / name for name in (".last.123.ckpt", ".last.ckpt.123")]  # of killed processes
    for leftover in leftovers:
        leftover.write_bytes(b"half")
    last.write_bytes(last.read_bytes()[:1000])
    with caplog.at_level(logging.WARNING):
        assert usable_checkpoint([last, best], shapes) == best
    assert [r.getMessage() for r in caplog.records] == [
        f"checkpoint {last} cannot be read (RuntimeError) and is passed over"
    ]
    assert not any(leftover.exists() for leftover in leftovers)
    assert usable_checkpoint([best], {"model.other": torch.Size([3])}) is None
    assert "belongs to another network" in caplog.messages[-1]


def test_reading_one_does_not_import_lightning() -> None:
    program = "import sys, attentionvote.training.checkpoint; print('lightning' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "False\n"
