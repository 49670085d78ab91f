"""What the export's tests share: a small network with random weights, its card, its exported graph, clouds."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warm_starter
from numpy.typing import NDArray
from tiny_network import EXPORT_CHANGES, TINY_ARGUMENTS, with_random_norms

from attentionvote.contract import ModelCard
from attentionvote.export.checkpoint_card import model_card
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part
from attentionvote.simulation.part_files import load_part
from attentionvote.training.checkpoint import save_trained

POINTS = 300
Cloud = tuple[NDArray[np.float32], NDArray[np.float32]]


def random_network(part: Part, seed: int = 0) -> AttentionVote:
    """Random weights and norms that are not the identity; votes stay near their seeds, so that peaks differ."""
    torch.manual_seed(seed)
    model = with_random_norms(AttentionVote.from_arguments(arguments_of(part)))
    for refiner in model.refiners:
        torch.nn.init.normal_(refiner.output.weight, std=0.05)
    return model


def arguments_of(part: Part) -> dict[str, Any]:
    """The network's arguments as a checkpoint keeps them."""
    box = [part.vertices.min(0).tolist(), part.vertices.max(0).tolist()]
    return TINY_ARGUMENTS | EXPORT_CHANGES | {"diameter": float(part.diameter), "box": box}


def metadata_of(part: Part, **changes: Any) -> dict[str, Any]:
    """A checkpoint's metadata for the small network."""
    from dataclasses import asdict

    stored: dict[str, Any] = {
        "format": 1,
        "version": "0.1.0",
        "model": arguments_of(part),
        "part": {
            "name": part.name,
            "title": part.title,
            "diameter": float(part.diameter),
            "digest": part.digest,
            "symmetry": asdict(part.symmetry),
        },
        "points": POINTS,
        "clouds": {
            "sensor": {"preset": "gaussian", "sigma_mm": 0.3},
            "density": 2000,
            "pool": 1000,
            "neighbors": 12,
        },
        "peak_threshold": 0.05,
        "confidence_threshold": 0.1,
        "data": {"test": "0" * 64},
        "test": {"ap_10": 0.5},
    }
    return stored | changes


def pile(part: Part, seed: int, count: int = POINTS) -> Cloud:
    """Surface points of three parts half a metre away, with unit normals of no meaning."""
    rng = np.random.default_rng(seed)
    surface = part.surface_points(count, rng)
    shift = rng.uniform(-part.diameter, part.diameter, (3, 3)) + np.array([0, 0, 0.5])
    points = (surface + shift[rng.integers(0, 3, count)]).astype(np.float32)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals.astype(np.float32)


@pytest.fixture(scope="session")
def part() -> Part:
    return load_part("brick", "builtin:brick")


@pytest.fixture(scope="session")
def network(part: Part) -> AttentionVote:
    return random_network(part)


@pytest.fixture(scope="session")
def make_network(part: Part) -> Callable[[int], AttentionVote]:
    return lambda seed: random_network(part, seed)


@pytest.fixture(scope="session")
def make_metadata(part: Part) -> Callable[..., dict[str, Any]]:
    return lambda **changes: metadata_of(part, **changes)


@pytest.fixture(scope="session")
def card(part: Part, network: AttentionVote) -> ModelCard:
    return model_card(network, metadata_of(part), part, (0.4, 0.7), 0.2, "run", "commit")


@pytest.fixture(scope="session")
def export(make_metadata: Callable[..., dict[str, Any]]) -> Callable[..., bytes]:
    """Export a network with a card in a process of its own; ``source`` is the folder of the package."""

    def run(
        network: AttentionVote, card: ModelCard, folder: Path, source: Path | None = None, **metadata: Any
    ) -> bytes:
        model, text, out = folder / "model.ckpt", folder / "card.json", folder / "model.onnx"
        save_trained(network, make_metadata(**metadata), model)
        text.write_text(card.to_json(), encoding="utf-8")
        environment = os.environ | ({"PYTHONPATH": str(source)} if source else {})
        command = [sys.executable, str(Path(__file__).with_name("export_script.py")), str(model), str(text), str(out)]
        warm_starter.run(command, check=True, timeout=280, env=environment, capture_output=True)
        return out.read_bytes()

    return run


@pytest.fixture(scope="session")
def graph(
    network: AttentionVote, card: ModelCard, export: Callable[..., bytes], tmp_path_factory: pytest.TempPathFactory
) -> bytes:
    """The exported network: some ten seconds, so what needs it is marked slow; once for all processes of a test run."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "exported"
    folder.mkdir(exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder / "done"
        if not done.exists():
            export(network, card, folder)
            done.touch()
    return (folder / "model.onnx").read_bytes()


@pytest.fixture(scope="session")
def make_cloud(part: Part) -> Callable[..., Cloud]:
    return lambda seed, count=POINTS: pile(part, seed, count)
