"""What the tests of the losses share: a box with every kind of symmetry, scenes of it, a small network."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import socket
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
import torch
from tiny_network import LOSS_CHANGES, tiny_network

from attentionvote.data.samples import Batch, collate
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.model.neighborhoods import find_neighborhoods
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part
from attentionvote.training.processes import joined

TILTED = (1.0, 2.0, 2.0)
ACROSS = (2.0, 1.0, -2.0)  # perpendicular to it
BOX_FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
BOX_FACES += [[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
OUTWARD = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]]).repeat(2, axis=0)
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
SYMMETRIES = {
    "none": Symmetry(),
    "cyclic 2": Symmetry("cyclic", order=2),
    "cyclic 3, tilted": Symmetry("cyclic", TILTED, order=3),
    "dihedral 2": Symmetry("dihedral", order=2),
    "dihedral 3": Symmetry("dihedral", order=3),
    "dihedral 4, tilted": Symmetry("dihedral", TILTED, order=4, flip_axis=ACROSS),
    "group": Symmetry("group", quaternions=[(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)]),
    "tetrahedral": Symmetry(
        "group", quaternions=[*np.eye(4), *((1, x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))]
    ),
    "revolution": Symmetry("revolution"),
    "revolution, tilted": Symmetry("revolution", TILTED),
    "revolution, flip": Symmetry("revolution", flip=True),
    "revolution, flip, tilted": Symmetry("revolution", TILTED, flip=True),
}


def box_with(symmetry: Symmetry | None = None) -> Part:
    """A box whose diameter is called 100 mm; the symmetry is a claim, which the distances take as given."""
    return Part("box", CORNERS * (0.02, 0.01, 0.045), np.array(BOX_FACES), 0.1, symmetry or Symmetry())


def random_rotations(seed: int, count: int) -> np.ndarray:
    return matrix_from_quaternion(random_quaternion(np.random.default_rng(seed), (count,)))


def scene_sample(seed: int, instances: int, visible: float = 1.0, count: int = 160) -> Batch:
    """Boxes side by side half a metre away, seen from the camera; some points lie on none. One sample, no batch."""
    rng, part = np.random.default_rng(seed), box_with()
    rotation = random_rotations(seed, instances)
    center = np.array([[0.07 * (i - (instances - 1) / 2), 0.02 * (i % 2), 0.5] for i in range(instances)])
    center = center.reshape(-1, 3)
    points, normals, owner = [], [], []
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    for i in range(instances):
        face = rng.choice(12, size=10 * count, p=area / area.sum())
        u, v, _ = rng.dirichlet([1, 1, 1], 10 * count).T[..., None]
        surface = (a[face] + u * (b - a)[face] + v * (c - a)[face]) @ rotation[i].T + center[i]
        direction = OUTWARD[face] @ rotation[i].T
        seen = np.flatnonzero((surface * direction).sum(1) < 0)[: (count - 8) // instances]
        points.append(surface[seen])
        normals.append(direction[seen])
        owner += [i] * len(seen)
    missing = count - len(owner)
    points.append(rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.7], (missing, 3)))
    normals.append(np.tile([0.0, 0, -1], (missing, 1)))
    owner += [-1] * missing
    order = rng.permutation(count)
    xyz = np.concatenate(points)[order].astype(np.float32)
    return Batch(
        torch.from_numpy(xyz),
        torch.from_numpy(np.concatenate(normals)[order].astype(np.float32)),
        torch.tensor(owner)[torch.from_numpy(order)],
        find_neighborhoods(xyz, loss_network().layout),
        torch.from_numpy(center).float(),
        torch.from_numpy(rotation).float(),
        torch.full((instances,), visible),
        torch.zeros(instances, dtype=torch.long),
    )


def loss_network(**changes: Any) -> AttentionVote:
    return tiny_network(**(LOSS_CHANGES | changes))


# Functions as fixtures of the session: test modules cannot import each other, and hypothesis wants no other scope.
@pytest.fixture(scope="session")
def make_box() -> Callable[..., Part]:
    return box_with


@pytest.fixture(scope="session", params=SYMMETRIES)
def symmetric_part(request: pytest.FixtureRequest) -> Part:
    return box_with(SYMMETRIES[request.param])


@pytest.fixture(scope="session")
def make_rotations() -> Callable[..., np.ndarray]:
    return random_rotations


@pytest.fixture(scope="session")
def make_network() -> Callable[..., AttentionVote]:
    return loss_network


@pytest.fixture(scope="session")
def make_sample() -> Callable[..., Batch]:
    return scene_sample


@pytest.fixture(scope="session")
def make_scenes() -> Callable[..., Batch]:
    """A batch of scenes with these numbers of instances."""
    return lambda *instances: collate([scene_sample(7 + i, n) for i, n in enumerate(instances)])


def _member(rank: int, count: int, port: int, work: Callable[[int], Any], answer: Connection) -> None:
    os.environ.update(RANK=str(rank), WORLD_SIZE=str(count), MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    torch.set_num_threads(1)
    try:
        with joined(torch.device("cpu")) as first_does:
            result = work(rank) if work.__code__.co_argcount == 1 else work(rank, first_does)  # type: ignore[call-arg]
        answer.send_bytes(pickle.dumps((result, "")))  # plain bytes: tensors would be shared with a process that ends
    except BaseException:
        answer.send_bytes(pickle.dumps((None, traceback.format_exc())))
    os._exit(0)


def run_in_processes(count: int, work: Callable[..., Any]) -> list[Any]:
    """``work(rank)``, or ``work(rank, first_does)``, in real processes joined by gloo; what each returned.

    They are forks of this one: importing torch again would take ten seconds each.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context, started = multiprocessing.get_context("fork"), []
    for rank in range(count):
        answers, answer = context.Pipe(duplex=False)
        process = context.Process(target=_member, args=(rank, count, port, work, answer))
        process.start()
        answer.close()
        started.append((process, answers))
    results = []
    for process, answers in started:
        try:
            assert answers.poll(60), "a process hangs"
            result, error = pickle.loads(answers.recv_bytes())
        finally:
            process.kill()
        assert not error, error
        results.append(result)
    return results


@pytest.fixture(scope="session")
def in_processes() -> Callable[[int, Callable[..., Any]], list[Any]]:
    return run_in_processes
